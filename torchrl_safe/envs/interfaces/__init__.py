"""The environments as other libraries know them.

* ``gymnasium``: what :func:`gymnasium.make` and :func:`gymnasium.make_vec` build;
* ``registration``: their ids, in Gymnasium's registry once ``torchrl_safe.envs`` is imported;
* ``suite``: dm_control's ``load("point", "goal")``, where dm_control can be installed.

Each wraps one core and translates; none holds state of its own. A module is imported by those who
use it.
"""
