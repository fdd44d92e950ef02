# SPDX-License-Identifier: Apache-2.0
"""False accusations: how often honest senders are named malicious, on long drives without any attack.

Drives are simulated while they are played: clouds are not stored, and of a drive only the last second is held. Every agent is an
ego, and accuses by itself. Honest sender-minutes are those in which the ego received the sender, within the range of communication.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import torch

from manyeyes.agents.replay import CachedOutputs, DetectionReplay, ReplayConfig, ReplayStep
from manyeyes.agents.strategies.registry import get_strategy
from manyeyes.agents.trust.registry import get_misbehaviour_detector
from manyeyes.datasets.odometry_drift import DriftingOdometry, OdometryDrift
from manyeyes.datasets.perturbation import PoseNoise
from manyeyes.evaluation.attacks.metrics import EventRate, count_false_accusations
from manyeyes.evaluation.attacks.records import DriveRecord, SenderRecord
from manyeyes.evaluation.detection.benchmark import load_detector
from manyeyes.simulator.record import make_first_scenario
from manyeyes.simulator.scene.scenario import ScenarioSpec
from manyeyes.studies.attacks.recording import SenderFrame, find_sender_frames, make_sender_records
from manyeyes.studies.attacks.weather import make_weather
from manyeyes.studies.engine.cells import Cell, CellStore
from manyeyes.studies.engine.report import StudyContext
from manyeyes.studies.options import FalseAccusationsOptions
from manyeyes.viz.study_table import StudyTable, format_number

RATE_HZ, FIRST_SEED = 10.0, 70_000
COMPUTED_BY = ("manyeyes.studies.attacks.false_accusations",)
CHANNEL, LATENCY_BUDGET_S, BUDGET_BYTES = "its-g5-6", 0.1, 4096
CACHE_NS = 1_000_000_000


@dataclass(frozen=True)
class HonestDrive:
    """One drive under one variant and all defences; what is stored is not played again."""

    spec: ScenarioSpec
    variant: str
    options: FalseAccusationsOptions
    store: CellStore

    def __call__(self) -> tuple[DriveRecord, ...]:
        """Load or play the records, by defence."""
        torch.set_num_threads(1)
        stored = {defence: self.store.load(self.make_cell(defence)) for defence in self.options.defences}
        missing = [defence for defence, record in stored.items() if record is None]
        for defence, record in zip(missing, self._play(missing) if missing else ()):
            self.store.save(self.make_cell(defence), record)
            stored[defence] = record
        return tuple(record for record in stored.values() if record is not None)

    def make_cell(self, defence: str) -> Cell[DriveRecord]:
        """Describe the stored record of one defence."""
        options, weights = self.options, load_detector(self.options.weights).fingerprint.hex()
        errors = options.position_sigma_m, options.heading_sigma_deg, options.seed
        sent = options.method, options.sight
        key = (self.spec, self.variant, get_misbehaviour_detector(defence), sent, weights, errors)
        return Cell(f"{self.spec.name}-{self.variant}-{defence}", DriveRecord, key, COMPUTED_BY)

    def _play(self, defences: Sequence[str]) -> list[DriveRecord]:
        """Simulate the drive frame by frame, and play it for each defence; detector outputs are shared."""
        options, scenario = self.options, make_first_scenario(self.spec, None)
        noise = PoseNoise(seed=options.seed).at_level(options.position_sigma_m, math.radians(options.heading_sigma_deg))
        odometry, change = DriftingOdometry(OdometryDrift(seed=options.seed)), make_weather(self.variant, options.seed)
        cache: CachedOutputs = {}
        players = [_Player.make(defence, options, cache) for defence in defences]
        for index in range(len(scenario)):
            measured = odometry.apply(scenario.snapshot(index))
            changed = change(noise.apply(measured, 0) if noise else measured)
            for player in players:
                player.add(player.replay.step(changed))
            now = changed.frames[0].timestamp_ns
            for key in [key for key in cache if key[1] < now - CACHE_NS]:
                del cache[key]
        return [player.make_record(self.spec.name) for player in players]


@dataclass
class _Player:
    """One replay of all agents as egos, and what they found of senders."""

    replay: DetectionReplay
    num_frames: int = 0
    rows: dict[int, dict[int, dict[int, SenderFrame]]] = field(default_factory=dict)

    @classmethod
    def make(cls, defence: str, options: FalseAccusationsOptions, cache: CachedOutputs) -> _Player:
        """Return the replay of a defence; cache: detector outputs that are read and extended."""
        config = ReplayConfig(
            channel=CHANNEL,
            budget_bytes=BUDGET_BYTES,
            latency_budget_s=LATENCY_BUDGET_S,
            all_egos=True,
            seed=options.seed,
            send_sight=options.sight,
            misbehaviour=get_misbehaviour_detector(defence),
        )
        return cls(DetectionReplay(options.method, load_detector(options.weights), config, cache))

    def add(self, steps: Iterable[ReplayStep]) -> None:
        for step in steps:
            ego = step.snapshot.frames[step.ego].agent_id
            for sender, row in find_sender_frames(step.perception).items():
                self.rows.setdefault(ego, {}).setdefault(sender, {})[self.num_frames] = row
        self.num_frames += 1

    def make_record(self, name: str) -> DriveRecord:
        senders = tuple[SenderRecord, ...]()
        for ego, rows in sorted(self.rows.items()):
            senders += make_sender_records(ego, rows, frozenset(), self.num_frames)
        return DriveRecord(name, tuple(sorted(self.rows)), ((), ()), senders, (), 1 / RATE_HZ, 0.0, 0.0)


@dataclass(frozen=True)
class AccusationRow:
    """One variant and defence over all drives. num_drives: played so far."""

    variant: str
    defence: str
    num_drives: int
    num_senders: int
    accusations: EventRate


def make_row(variant: str, defence: str, records: Sequence[DriveRecord]) -> AccusationRow:
    """Return the row of the drives of one variant and defence."""
    num_senders = sum(len(record.senders) for record in records)
    return AccusationRow(variant, defence, len(records), num_senders, count_false_accusations(records))


def make_specs(options: FalseAccusationsOptions) -> list[ScenarioSpec]:
    """Return the drives: four vehicles and a roadside unit, in traffic as of the preset carla-towns-small."""
    return [
        ScenarioSpec(
            town=options.towns[k % len(options.towns)],
            seed=FIRST_SEED + 1000 * options.seed + 50 * k,
            name=f"honest-{k:03d}",
            vehicles=4,
            frames=round(options.seconds * RATE_HZ),
            history_frames=0,
            roadside_chance=1.0,
            lidar="opv2v-16",
            density=8.0,
            clutter=1.4,
            intensity="material",
        )
        for k in range(options.drives)
    ]


def run(options: FalseAccusationsOptions, context: StudyContext) -> None:
    """Play all drives, and write the report."""
    get_strategy(options.method)
    for name in options.defences:
        get_misbehaviour_detector(name)
    context = replace(context, seed=options.seed)
    specs = make_specs(options)
    # A job for each variant of a drive: what an interrupted study loses, and what the progress bar counts, are small.
    jobs = [HonestDrive(spec, variant, options, context.store) for spec in specs for variant in options.variants]
    found = context.run_jobs(jobs, options.workers, "Drives and their variants")
    rows = tuple(
        make_row(variant, defence, [records[k] for job, records in zip(jobs, found) if job.variant == variant])
        for variant in options.variants
        for k, defence in enumerate(options.defences)
    )
    method = f"{options.method} with sights" if options.sight else options.method
    title = f"{len(specs)} drives of {options.seconds:g} s in {', '.join(options.towns)}, every agent as ego, {method}"
    context.write_report(title, {"rows": rows}, [make_table(rows)], config={"specs": specs})


def make_table(rows: tuple[AccusationRow, ...]) -> StudyTable:
    """Tabulate the rates with their bounds."""
    headings = ("returns", "defence", "sender-minutes", "accusations", "per minute", "95 % CI", "one-sided 95 % bound")
    lines = tuple(
        (
            row.variant,
            row.defence,
            format_number(row.accusations.minutes, 1),
            str(row.accusations.events),
            format_number(row.accusations.value, 4),
            f"[{row.accusations.low:.4f}, {row.accusations.high:.4f}]",
            format_number(row.accusations.upper, 4),
        )
        for row in rows
    )
    return StudyTable("False accusations per honest sender-minute", headings, lines)
