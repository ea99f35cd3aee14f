"""Settings of all benchmarks."""

import torch

# Ratios between threaded programs depend on the machine; those on one thread hardly do.
torch.set_num_threads(1)
