# SPDX-License-Identifier: Apache-2.0
"""Map observations of a fleet: places, a true map that changes over time, and the output of each agent's map model."""

from manyeyes.simulator.fleet.changing_map import Change, ChangingMap
from manyeyes.simulator.fleet.config import CROWDS, CrowdConfig, crowd_config
from manyeyes.simulator.fleet.place import PLACES, Place, clip_to_box, load_place, make_place
from manyeyes.simulator.fleet.simulate import ROLES, Crowd, simulate_crowd

__all__ = [
    "CROWDS",
    "PLACES",
    "ROLES",
    "Change",
    "ChangingMap",
    "Crowd",
    "CrowdConfig",
    "Place",
    "clip_to_box",
    "crowd_config",
    "load_place",
    "make_place",
    "simulate_crowd",
]
