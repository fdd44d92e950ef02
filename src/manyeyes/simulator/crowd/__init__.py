# SPDX-License-Identifier: Apache-2.0
"""Map observations of a fleet: places to drive in, a true map that changes, and what each agent's map model says of it."""

from manyeyes.simulator.crowd.config import CROWDS, CrowdConfig, crowd_config
from manyeyes.simulator.crowd.place import PLACES, Place, clip_to_box, place, place_of
from manyeyes.simulator.crowd.simulate import ROLES, Crowd, simulate_crowd
from manyeyes.simulator.crowd.world import Change, World

__all__ = [
    "CROWDS",
    "PLACES",
    "ROLES",
    "Change",
    "Crowd",
    "CrowdConfig",
    "Place",
    "World",
    "clip_to_box",
    "crowd_config",
    "place",
    "place_of",
    "simulate_crowd",
]
