# SPDX-License-Identifier: Apache-2.0
"""Conditions of the study: attack, number of malicious agents, defence; and the job that plays one scenario under all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from manyeyes.agents.replay import CachedOutputs, ReplayConfig
from manyeyes.agents.strategies.names import form_of
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.agents.trust.interface import MisbehaviourDetector
from manyeyes.agents.trust.registry import get_misbehaviour_detector
from manyeyes.datasets.base import Recording
from manyeyes.datatypes import Snapshot
from manyeyes.evaluation.attacks.records import DriveRecord
from manyeyes.evaluation.detection.accumulator import MetricAccumulator
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, load_detector, resolve_protocol
from manyeyes.studies.attacks.catalog import get_attack
from manyeyes.studies.attacks.drive import AttackedDrive, DriveSetting
from manyeyes.studies.attacks.recording import DriveRecorder
from manyeyes.studies.attacks.roles import Roles, choose_roles
from manyeyes.studies.engine.cells import Cell, CellStore

NO_ATTACK, NO_DEFENCE, ORACLE = "none", "none", "oracle"
COMPUTED_BY = ("manyeyes.studies.attacks.conditions",)


@dataclass(frozen=True)
class AttackCondition:
    """attack: a name of the catalog, or NO_ATTACK. defence: NO_DEFENCE, ORACLE, or a misbehaviour detector by name."""

    attack: str = NO_ATTACK
    num_malicious: int = 1
    defence: str = NO_DEFENCE

    @property
    def name(self) -> str:
        """How tables call it."""
        return f"{self.attack} x{self.num_malicious}, {self.defence}"

    def make_detector(self) -> MisbehaviourDetector | None:
        """Return the defence of the ego; the oracle drops messages before they arrive."""
        return None if self.defence in (NO_DEFENCE, ORACLE) else get_misbehaviour_detector(self.defence)

    def make_setting(self, method: str, replay: ReplayConfig, roles: Roles) -> DriveSetting:
        """Return the setting of one drive."""
        replay = replace(replay, misbehaviour=self.make_detector())
        named = None if self.attack == NO_ATTACK else get_attack(self.attack)
        attack = None if named is None else named.attack
        return DriveSetting(
            method, replay, roles, attack, named is not None and named.colluding, self.defence == ORACLE
        )


@dataclass(frozen=True)
class AttackScenarioJob:
    """One scenario under all conditions with all methods; what is stored is not played again.

    config: weights, protocol, replay, pose errors. pairs: conditions with methods. num_egos: agents that are the ego in turn.
    """

    open_recording: Callable[[], Recording]
    config: BenchmarkConfig
    scenario: str
    pairs: tuple[tuple[AttackCondition, str], ...]
    num_egos: int
    store: CellStore
    recording_hash: str

    def __call__(self) -> tuple[DriveRecord, ...]:
        """Load or play every pair, in their order."""
        torch.set_num_threads(1)
        stored = [self.store.load(self.make_cell(*pair)) for pair in self.pairs]
        player = None
        records = list[DriveRecord]()
        for pair, record in zip(self.pairs, stored):
            if record is None:
                player = player or ScenarioPlayer.open(self)
                record = player.play(*pair)
                self.store.save(self.make_cell(*pair), record)
            records.append(record)
        return tuple(records)

    def make_cell(self, condition: AttackCondition, method: str) -> Cell[DriveRecord]:
        """Describe the stored record of one pair."""
        config = replace(self.config, methods=(method,), weights=load_detector(self.config.weights).fingerprint.hex())
        attack = None if condition.attack == NO_ATTACK else get_attack(condition.attack)
        key = (condition, attack, condition.make_detector(), config, self.scenario, self.num_egos, self.recording_hash)
        return Cell(f"{self.scenario}-{condition.attack}-{condition.defence}", DriveRecord, key, COMPUTED_BY)


@dataclass(frozen=True, eq=False)
class ScenarioPlayer:
    """The snapshots of a scenario, as agents get them, and detector outputs that all conditions share."""

    job: AttackScenarioJob
    snapshots: dict[int, Snapshot]
    eval_indices: range
    feature_cache: CachedOutputs

    @classmethod
    def open(cls, job: AttackScenarioJob) -> ScenarioPlayer:
        """Read the snapshots of a scenario."""
        recording, perturb = job.config.filter_recording(job.open_recording()), job.config.make_perturbation()
        indices = recording.eval_indices(job.scenario)
        first = max(0, indices.start - job.config.replay.warmup_frames)
        snapshots = {k: perturb(recording.snapshot(job.scenario, k)) for k in range(first, indices.stop)}
        return cls(job, snapshots, indices, {})

    def play(self, condition: AttackCondition, method: str) -> DriveRecord:
        """Play one condition with every ego in turn; an ego without an honest majority around it is left out."""
        job, first = self.job, self.snapshots[self.eval_indices.start]
        metrics = MetricAccumulator(method, resolve_protocol(job.config))
        recorders = list[DriveRecorder]()
        for row in range(min(job.num_egos, len(first.frames))):
            replay = job.config.replay
            roles = choose_roles(first, row, condition.num_malicious, replay.comm_range_m, replay.seed)
            if roles is not None:
                recorders.append(self._play_ego(condition.make_setting(method, replay, roles), metrics))
        stamps = [snapshot.frames[0].timestamp_ns for snapshot in self.snapshots.values()]
        period_s = (stamps[-1] - stamps[0]) / max(1, len(stamps) - 1) / 1e9
        mean_bytes = sum(m.num_bytes for m in metrics.messages) / max(1, len(metrics.messages))
        return DriveRecord(
            job.scenario,
            tuple(recorder.ego for recorder in recorders),
            metrics.match_frames(),
            tuple(sender for recorder in recorders for sender in recorder.senders()),
            tuple(claim for recorder in recorders for claim in recorder.claims()),
            period_s,
            mean_bytes,
            1e3 * sum(metrics.perceive_s) / max(1, len(metrics.perceive_s)),
        )

    def _play_ego(self, setting: DriveSetting, metrics: MetricAccumulator) -> DriveRecorder:
        drive = AttackedDrive(self.job.scenario, load_detector(self.job.config.weights), setting, self.feature_cache)
        recorder = DriveRecorder(setting.roles.ego, setting.roles.identities(setting.num_pseudonyms))
        for index, snapshot in self.snapshots.items():
            is_attacked = index >= self.eval_indices.start
            played = drive.play(snapshot, is_attacked)
            if is_attacked:
                recorder.add(played)
            if index in self.eval_indices:
                metrics.add(played.step)
        return recorder


def list_pairs(
    attacks: Sequence[str], methods: Sequence[str], defences: Sequence[str], counts: Sequence[int]
) -> tuple[tuple[AttackCondition, str], ...]:
    """Return the conditions of a study with their methods: each attack undefended and with each defence, and the baselines.

    Baselines for each number of malicious agents: nothing attacked, without and with each defence; the oracle; and no fusion. The
    oracle is the same for every attack, since nothing of malicious agents reaches the ego. counts: of the first attack, further
    numbers of malicious agents.
    """
    found = dict[tuple[AttackCondition, str], None]()
    sizes = dict.fromkeys([*(get_attack(name).num_malicious for name in attacks), *counts])
    for method in methods:
        for size in sizes:
            found[AttackCondition(num_malicious=size), f"no-fusion{form_of(method)}"] = None
            for defence in (NO_DEFENCE, *defences, ORACLE):
                found[AttackCondition(NO_ATTACK, size, defence), method] = None
        for name in attacks:
            named = get_attack(name)
            if named.needs_tokens and not get_strategy(method).needs_tokens:
                continue
            for size in dict.fromkeys((named.num_malicious, *(counts if name == attacks[0] else ()))):
                for defence in (NO_DEFENCE, *defences):
                    found[AttackCondition(name, size, defence), method] = None
    return tuple(found)
