"""Trainers: whole methods on the blocks, with runs that survive what happens to them."""
