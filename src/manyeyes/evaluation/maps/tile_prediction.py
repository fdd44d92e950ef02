# SPDX-License-Identifier: Apache-2.0
"""What studies of the map model draw: local maps, tiles from one look and from more, and tiles under errors of claimed poses.

Every look reaches its tile as packets, an agent's own too (agents.mapping). Sources: CrowdMap Tables 1 and 2; specs: maps.md 1.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from manyeyes.agents.map_features import draw_tile, receive, share_look
from manyeyes.agents.perception_cache import Eyes
from manyeyes.agents.pose_correction import Aligner
from manyeyes.agents.strategies.late import Late
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.datatypes import AgentFrame, Message, Transform
from manyeyes.datatypes.map_element import MapElements
from manyeyes.evaluation.maps.tile_cells import Drawing
from manyeyes.evaluation.maps.tile_sampling import Scenery, crowd_tile, local_tile, meeting, upright
from manyeyes.evaluation.maps.tiles import cut_to
from manyeyes.models import pretrained
from manyeyes.models.checkpoint import fingerprint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.maps.map_model import Mapper

VEHICLE, ROADSIDE = "vehicle", "roadside unit"
CLEAN, NOISY, CORRECTED, UNHURT = "clean", "noisy", "noisy, corrected", "clean, corrected"
ALONE = "one vehicle"


@dataclass(frozen=True)
class DrawLocal:
    """What lies ahead of each agent of a scenario, from its own look alone; a row for vehicles and one for roadside units.

    The model draws its whole tile about the agent, and what lies in the window is cut out of it, as agents do who survey locally.
    """

    @property
    def key(self) -> str:
        """Nothing to set."""
        return repr(self)

    def __call__(self, mapper: Mapper, scenery: Scenery, scenario: str, seed: int) -> Sequence[Drawing]:
        """One drawing an agent."""
        snapshot, out = meeting(scenery, scenario, seed), []
        for row, frame in enumerate(snapshot.frames):
            tile, window = local_tile(scenery, snapshot, row)
            look = _Look.of(mapper, frame)
            drawn = cut_to(draw_tile(mapper, look.heard, tile.world_from_tile), Transform.identity(), window)
            out.append(Drawing(ROADSIDE if frame.is_infrastructure else VEHICLE, drawn, tile.truth, look.sent))
        return out


@dataclass(frozen=True)
class DrawSemiGlobal:
    """The tile about a scenario's first agent from one look, and from more of a crowd; a row for each number of looks."""

    looks: tuple[int, ...] = (1, 2, 5, 10)

    @property
    def key(self) -> str:
        """The numbers of looks."""
        return repr(self)

    def __call__(self, mapper: Mapper, scenery: Scenery, scenario: str, seed: int) -> Sequence[Drawing]:
        """One drawing a number of looks; all share what they are a part of."""
        config = mapper.config
        tile = crowd_tile(scenery, scenario, seed, max(self.looks), config.tile, config.bev.grid)
        seen = [_Look.of(mapper, frame) for frame in tile.looks]
        return [_drawing(str(count), mapper, seen[:count], tile.world_from_tile, tile.truth) for count in self.looks]


@dataclass(frozen=True)
class DrawPose:
    """The tile about a scenario's first agent from all agents that meet there at one instant, others' claimed poses in error.

    sigma_m: of each axis; headings err by as many degrees times deg_per_m. The first agent knows its own pose, in whose frame the
    tile lies. aligner: corrects others' poses by objects that both detect; what it leaves out is not drawn from. detector: the
    weights that detect; in every row boxes travel with looks, and are in their bytes.
    """

    sigma_m: float = 0.5
    deg_per_m: float = 2.0
    aligner: Aligner = Aligner()
    detector: str = pretrained.DEFAULT

    @property
    def key(self) -> str:
        """The errors, the corrector and its weights, and the detector's."""
        net = self.aligner.net
        return repr((self, fingerprint(_detector(self.detector)), None if net is None else fingerprint(net)))

    def __call__(self, mapper: Mapper, scenery: Scenery, scenario: str, seed: int) -> Sequence[Drawing]:
        """Rows: one vehicle; clean; noisy; noisy, corrected; clean, corrected."""
        snapshot = meeting(scenery, scenario, seed)
        own = snapshot.frames[0]
        world_from_tile = upright(own)
        truth = scenery.truth(scenario, world_from_tile, mapper.config.tile)
        noise = PoseNoise("collaborators_iid", self.sigma_m, float(np.radians(self.deg_per_m * self.sigma_m)), seed)
        before = scenery.recording.snapshot(scenario, snapshot.index - 1).frames if snapshot.index else ()
        eyes = [_eyes_of(self.detector, frame, before) for frame in snapshot.frames]
        clean, noisy = (
            [_Look.of(mapper, frame, one) for frame, one in zip(frames, eyes)]
            for frames in (snapshot.frames, noise.apply(snapshot, 0).frames)
        )
        out = [
            _drawing(row, mapper, seen, world_from_tile, truth)
            for row, seen in ((ALONE, clean[:1]), (CLEAN, clean), (NOISY, noisy))
        ]
        for row, seen in ((CORRECTED, noisy), (UNHURT, clean)):
            told = [message for look in seen[1:] for message in look.heard]
            kept = self.aligner.align(own, eyes[0], told, {}).messages
            drawn = draw_tile(mapper, [*seen[0].heard, *kept], world_from_tile)
            out.append(Drawing(row, drawn, truth, tuple(size for look in seen for size in look.sent)))
        return out


@dataclass(frozen=True)
class _Look:
    """A look as it came through the air. heard: its message, none where nothing was seen; sent: its bytes."""

    heard: tuple[Message, ...]
    sent: tuple[int, ...]

    @classmethod
    def of(cls, mapper: Mapper, frame: AgentFrame, eyes: Eyes | None = None) -> _Look:
        said = None if eyes is None else Late().say(eyes, frame)
        packets = share_look(mapper, frame, objects=None if said is None else said.objects)
        message = receive(packets, mapper)
        return cls(() if message is None else (message,), (sum(map(len, packets)),) if packets else ())


def _drawing(
    row: str, mapper: Mapper, seen: Sequence[_Look], world_from_tile: Transform, truth: MapElements
) -> Drawing:
    messages = [message for look in seen for message in look.heard]
    sent = tuple(size for look in seen for size in look.sent)
    return Drawing(row, draw_tile(mapper, messages, world_from_tile), truth, sent)


def _eyes_of(detector: str, frame: AgentFrame, before: Sequence[AgentFrame]) -> Eyes:
    """An agent's eyes that saw its sweep before this one."""
    eyes = Eyes(_detector(detector))
    for earlier in before:
        if earlier.agent_id == frame.agent_id:
            eyes.see(earlier)
    return eyes


@lru_cache(maxsize=2)
def _detector(name: str) -> Detector:
    return pretrained.load(name)
