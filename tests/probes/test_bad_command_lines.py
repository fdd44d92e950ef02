# SPDX-License-Identifier: Apache-2.0
"""Bad command lines: each ends with a nonzero code and at most two lines that name the option, value or file; no traceback.

Short form: calls of ``main`` in this process. Long form (MANYEYES_PROBES=long): a process for each line, too.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

pytest.importorskip("pyarrow", reason="the 'map' extra is not installed")
pytest.importorskip("shapely", reason="the 'map' extra is not installed")

from manyeyes.cli import main as cli
from manyeyes.datasets.opv2v import Opv2vWriter
from manyeyes.datatypes import AgentFrame, Boxes, GroundTruth, PointCloud, Snapshot, Transform
from manyeyes.models import checkpoint
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY

MAX_SECONDS = 30
HUGE = 2**70

NO_COMMAND = """
demmo | did you mean demo
--frames 3 | --frames
map fuze a | did you mean fuse
map fuse-all a | fuse
study budgets | known commands
study pose-noise | pose-noise-ap
simulat | simulate
"""
NUMBERS = f"""
demo --seed {HUGE} | --seed
demo --seed -1 | --seed
demo --frames 0 | --frames
demo --min-score nan | --min-score
demo --min-score 1.5 | --min-score
demo --budget-bytes -1 | --budget-bytes
demo --latency-budget-ms nan | --latency-budget-ms
demo --latency-budget-ms -5 | --latency-budget-ms
demo --latency-budget-ms 1e300 | --latency-budget-ms
live run {{rec}} --rate 0 | --rate
live demo --rate nan | --rate
live demo --agents 0 | --agents
live map --seconds nan | --seconds
live map --port 0 | --port
report check-cells {{rec}} --count 0 | --count
study byte-curves --data {{rec}} --budgets -5 | --budgets
study attacks --data {{rec}} --counts -1 | --counts
study attacks --data {{rec}} --attacks ghosts | ghosts
study false-accusations --drives 0 | --drives
study false-accusations --seconds nan | --seconds
keys anchor --days 0 | --days
keys issue stem --lifetime-min 0 | --lifetime-min
keys pool --out pool --count 0 | --count
keys demo --agents -1 | --agents
simulate --workers 0 | --workers
simulate --workers 1000000000 | --workers
simulate --seed 0.5 | --seed
train --data {{rec}} --batch 0 | --batch
train --data {{rec}} --batch 1000000000000 | --batch
train --data {{rec}} --threads 0 | --threads
train --data {{rec}} --threads 1000000000 | --threads
train --data {{rec}} --seed {HUGE} | --seed
train --data {{rec}} --steps 0 | --steps
train --data {{rec}} --learning-rate -1 | --learning-rate
train --data {{rec}} --learning-rate inf | --learning-rate
train --data {{rec}} --learning-rate 1e30 | --learning-rate
finetune --data {{rec}} --holdout 1.5 | --holdout
finetune --data {{rec}} --max-frames 0 | --max-frames
calibrate --data {{rec}} --weights costr-small --out x.safetensors --max-frames 0 | --max-frames
check {{rec}} --scenarios 0 | --scenarios
evaluate --data {{rec}} --workers 0 | --workers
evaluate --data {{rec}} --workers {HUGE} | --workers
evaluate --data {{rec}} --noise-xy-m nan | --noise-xy-m
evaluate --data {{rec}} --noise-xy-m 1e200 | --noise-xy-m
evaluate --data {{rec}} --noise-yaw-deg -1 | --noise-yaw-deg
evaluate --data {{rec}} --timing-frames -1 | --timing-frames
evaluate --data {{rec}} --frame-stride 0 | --frame-stride
replay {{rec}} --frames -3 | --frames
replay {{rec}} --frame -1 | --frame
pose {{rec}} --min-score -0.1 | --min-score
pose {{rec}} --frames two | --frames
export {{rec}} --format waymo | --format
export {{rec}} --min-score 2 | --min-score
view {{rec}} --width 0 | --width
view {{rec}} --width 1000000000 | --width
view {{rec}} --half-extent-m 0 10 | --half-extent-m
view {{rec}} --half-extent-m 10 | --half-extent-m
fit-codebook --data {{rec}} --out x.safetensors --weights {{weights}} --stages 0 | --stages
fit-codebook --data {{rec}} --out x.safetensors --weights {{weights}} --stages 10000000 | --stages
map simulate cross --size nan | --size
map simulate cross --size 1e12 | --size
map simulate cross --observations 0 | --observations
map simulate cross --pose-sigma -1 | --pose-sigma
map build {{rec}} --scenarios 0 | --scenarios
map import {{text}} --min-score 7 | --min-score
map import {{text}} --origin nan 8 | --origin
map export {{map}} x.geojson --simplify-m -1 | --simplify-m
map view {{map}} --max-observations 0 | --max-observations
map fuse {{obs}} --workers 0 | --workers
study bandwidth --data {{rec}} --budgets 0 | --budgets
study bandwidth --data {{rec}} --budgets 64 nan | --budgets
study fusion --seeds 0 | --seeds
study fusion --observation-counts 0 | --observation-counts
study adversarial --seeds -1 | --seeds
study malicious-agents --fractions 1.5 | --fractions
study malicious-agents --offsets-m -1 | --offsets-m
study crowdmap-table3 --workers 0 | --workers
study num-agents --data {{rec}} --seed -1 | --seed
study sensors --data {{rec}} --seed -1 | --seed
study strata --data {{rec}} --seed -1 | --seed
study local --data {{rec}} --scenario-stride 0 | --scenario-stride
study tuning --workers 0 | --workers
"""
NAMES = """
demo --methods lat | late
demo --methods late late | --methods
demo --methods | --methods
demo --channel its-g6 | its-g5
demo --token-encoding int7 | int8
demo --weights costr-smal | costr-small
demo --pose-correction vote | voting
demo --colour | --colour
simulate --preset carla-town-small | carla-towns-small
simulate --preset smoke-opv2v --towns {missing} | {missing}
train --data {rec} --preset costr-smal/stage1 | costr-small/stage1
train --data {rec} --fusion maximum | max
train --data {rec} --preset map-tiny --fusion max | --fusion
train --data {rec} --split nosuch | nosuch
train --data {rec} --split test --weights {missing}.safetensors | {missing}.safetensors
evaluate --data {rec} --split test --protocol opencod | opencood
evaluate --data {rec} --split test --methods intermedite | intermediate
replay {rec} --split test --scenario zzz | zzz
replay {rec} --split test --weights {weights} --scenario aa --frame 1000000 | 1000000
view {rec} --split test --frame 99 | 99
check {missing} | {missing}
check {rec} --split test --weights {missing}.safetensors | {missing}.safetensors
finetune --data {rec} --split nosuch | nosuch
view {rec} --split test --detect lat | late
pose {rec} --split test --correctors votin | voting
pose {rec} --split test --correctors | --correctors
map simulate crosss | cross
map simulate grid-1000000 --size 60 | grid-
map simulate cross --crowd locl | local
map fuse {obs} --method chamfer_nms | chamfer-nms
map fuse {obs} --method nosuch | nosuch
map fuse {obs} --store {folder}/store --executor thread | inline
map fuse {obs} --store {folder}/store --method union | --store
map export {map} x.shp | geojson
map export {map}@2 x.geojson | only a store has releases
map export nothing://x x.geojson | nothing://x
map export memory://x/y x.geojson | memory://x/y
map diff {map} memory://x/y | memory://x/y
map view memory://x/y | memory://x/y
map evaluate memory://x/y --truth {map} | memory://x/y
map import memory://x/y | memory://x/y
map retract memory://x/y --ids ab --reason x --executor inline | memory://x/y
map export {map} x.json | x.json
map export {map} x.json --format geojsn | geojson
map import {text} | --poses
map import {text} --poses {text} | --origin
map import {text} --poses {text} --nuscenes {folder} | --nuscenes
map build {rec} --split test --source thruth | truth
map build {rec} --split test --map-mode globl | map-mode
map build {rec} --split test --source truth --channel its-g | its-g5
map retract {map} --reason x | --ids
map view {map} --out x.jpg | .html
map diff {map} {map} --out x.txt | .json
study robustness --data {rec} --split test --weights {weights} --perturbations nosuch | nosuch
study robustness --data {rec} --split test --weights {weights} --checkpoints nosuch | nosuch
study bandwidth --data {rec} --split test --weights {weights} --token-selection nosuch | nosuch
study bandwidth --data {rec} --split test --weights {weights} --token-encodings nosuch | nosuch
study ablation --data {rec} --split test --checkpoints {weights}@12 | --checkpoints
study ablation --data {rec} --split test --checkpoints a={weights}@-12 | -12
study ablation --data {rec} --split test | --checkpoints
study feakm --data {rec} --split test --checkpoints a=b | 'a'
study pose-estimation --data {rec} --split test --correctors nosuch | nosuch
study pose-noise-ap --data {rec} --split test --weights {weights} --correctors nosuch | nosuch
study fusion --methods nosuch | nosuch
study fusion --places nowhere | nowhere
study fleet-pose-noise --places nowhere | nowhere
study adversarial --places nowhere | nowhere
study malicious-agents --places nowhere | nowhere
study tuning --methods nosuch | nosuch
study map-pose-noise --data {rec} --split test --pose-correction nosuch | nosuch
study full-map --data {rec} --split test --methods nosuch | nosuch
study local --data {rec} --split test --weights nosuch | nosuch
"""
FILES = """
demo --weights {missing}.safetensors | {missing}
demo --weights {empty}.safetensors | {empty}
demo --weights {folder} | {folder}
demo --frames 2 --out {text} | {text}
demo --towns {text} --frames 2 | {text}
simulate --preset smoke-opv2v --out {text} | {text}
train --data {missing} | {missing}
train --data {text} | {text}
train --data {folder} | {folder}
train --data {rec} | {rec}
train --data {rec} --split test --preset costr-tiny --steps 1 --out {text} | {text}
train --data {rec} --split test --preset costr-tiny --weights {text} | {text}
train --data {rec} --split test --preset costr-tiny --weights {weights} {weights} | --weights
evaluate --data {missing} --split test | {missing}
evaluate --data {rec} --split test --weights {text} | {text}
evaluate --data {rec} --split test --pose-correction {missing}.safetensors | {missing}
evaluate --data {damaged} --split test --weights {weights} --workers 1 | vehicles
replay {damaged} --split test --weights {weights} | vehicles
replay {text} | {text}
export {missing} | {missing}
report docs --root {missing} | {missing}
study main-table --data {missing} | {missing}
live run {missing} | {missing}
live replay {missing} | {missing}
live replay {text} | no whole recording
live export {missing} | {missing}
live export {text} | no whole recording
keys issue stem --issuer {missing} | {missing}
keys revoke {text} | no certificate
keys trust {missing} | {missing}
keys show {text} | no certificate
keys verify {missing} | {missing}
export {rec} --split test --scenario zz | zz
export {rec} --split test --out {text} | {text}
export {damaged} --split test --weights {weights} | vehicles
view {missing} | {missing}
view {rec} --split test --out {folder} | {folder}
view {rec} --half-extent-m 0.1 10000 | --half-extent-m
view {rec} --split test --out {text}/a.png | {text}
view {damaged} --split test | vehicles
replay {short} --split test --weights {weights} | aa
evaluate --data {short} --split test --weights {weights} --workers 1 --out {folder}/e | aa
pose {short} --split test --weights {weights} --out {folder}/p | aa
view {short} --split test | aa
fit-codebook --data {short} --split test --weights {weights} --out {folder}/w.safetensors | no agent shares
pose {folder} | {folder}
pose {rec} --split test --weights {weights} --out {text} | {text}
fit-codebook --data {rec} --out x.safetensors --weights {missing} | {missing}
fit-codebook --data {rec} --out x.safetensors --weights {folder} | {folder}
fit-codebook --data {rec} --split test --out {folder} --weights {weights} | {folder}
map fuse {missing} | {missing}
map fuse {folder} | {folder}
map fuse {text} | {text}
map fuse {empty}.parquet | {empty}
map fuse {obs} --out {text} | {text}
map fuse {obs} --store {text} | {text}
map evaluate {missing} | {missing}
map evaluate {map} --truth {folder} | {folder}
map evaluate {text} | {text}
map diff {map} {missing} | {missing}
map diff {map} {folder} | {folder}
map export {folder} x.geojson | {folder}
map export {map} {folder} | {folder}
map export {map} {text}/x.geojson | {text}
map view {missing} | {missing}
map view {map} --truth {missing} | {missing}
map view {map} --observations {missing} | {missing}
map import {missing} --poses {text} --origin 49 8 | {text}
map import {text} --poses {missing} --origin 49 8 | {missing}
map import {text} --poses {folder} --origin 49 8 | {folder}
map import {text} --nuscenes {folder} | {folder}
map build {missing} | {missing}
map build {rec} --split test --weights {weights} | {weights}
map build {rec} --split test --source truth --map {missing}.osm | {missing}
map build {rec} --split test --source truth --map {text} | {text}
map retract {missing} --ids ab --reason x | {missing}
study robustness --data {missing} | {missing}
study bandwidth --data {rec} --split test --weights {text} | {text}
study ablation --data {rec} --split test --checkpoints a={missing}.safetensors | {missing}
study feakm --data {rec} --split test --checkpoints a={weights},{missing}.safetensors | {missing}
study semi-global --data {folder} | {folder}
study shared-bandwidth --data {folder} | {folder}
study qualitative --data {text} | {text}
map view {map} --out {folder} | {folder}
map simulate cross --out {text}/sub | {text}
study fusion --out {text} | {text}
"""
TABLES = {"command": NO_COMMAND, "number": NUMBERS, "name": NAMES, "file": FILES}
CASES = [line.strip() for table in TABLES.values() for line in table.strip().splitlines()]


def make_snapshot(scenario: str, index: int) -> Snapshot:
    """Two vehicles 15 m apart over flat ground, with one parked car."""
    generator = torch.Generator().manual_seed(index)
    poses = [Transform.from_xyz_yaw(15.0 * k + index, 4.0 * k, 0, 0.1) for k in range(2)]
    clouds = [
        PointCloud.of((torch.rand(200, 3, generator=generator) - 0.5) * torch.tensor([80.0, 80.0, 0.02])) for _ in poses
    ]
    frames = [
        AgentFrame(5 + k, index * 100_000_000, clouds[k], pose, torch.zeros(3, 3)) for k, pose in enumerate(poses)
    ]
    boxes = Boxes.of([[8.0, 5.0, 0.8]], [[4.6, 1.9, 1.6]], [0.4], id=torch.tensor([50]))
    return Snapshot(
        scenario, index, tuple(frames), GroundTruth(boxes, torch.ones(2, 1, dtype=torch.bool), Transform.stack(poses))
    )


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Good and bad input files by the names that the tables use."""
    root = tmp_path_factory.mktemp("probes")
    for scenario in ("aa", "bb"):
        writer = Opv2vWriter(root / "rec" / "test" / scenario)
        for index in range(3):
            writer.write(make_snapshot(scenario, index))
        writer.close({"history_frames": 1})
    writer = Opv2vWriter(root / "damaged" / "test" / "aa")
    for index in range(3):
        writer.write(make_snapshot("aa", index))
    writer.close({"history_frames": 1})
    shutil.copytree(root / "damaged", root / "short")
    (root / "short" / "test" / "aa" / "data_protocol.yaml").write_text("history_frames: 1000\n")
    for yaml in (root / "damaged").rglob("0*.yaml"):
        yaml.write_text("lidar_pose: abc\nvehicles: 5\n")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        checkpoint.save(Detector(COSTR_TINY), root / "tiny.safetensors", {})
    (root / "notes.txt").write_text("no such format\n")
    (root / "folder").mkdir()
    for suffix in ("safetensors", "parquet"):
        (root / f"empty.{suffix}").touch()
    assert cli.main(f"map simulate cross --observations 4 --size 60 --out {root / 'fleet'}".split()) == 0
    assert cli.main(f"map fuse {root / 'fleet'}".split()) == 0
    return {
        "rec": root / "rec", "damaged": root / "damaged", "short": root / "short", "weights": root / "tiny.safetensors",
        "text": root / "notes.txt", "folder": root / "folder", "empty": root / "empty", "missing": root / "missing",
        "obs": root / "fleet" / "observations", "map": root / "fleet" / "map",
    }  # fmt: skip


def test_there_are_enough_lines_for_every_command() -> None:
    assert len(CASES) >= 110
    commands = [name for name in cli.COMMANDS if name not in cli.COMMAND_GROUPS and name != "doctor"]
    commands += [f"{group} {name}" for group, table in cli.COMMAND_GROUPS.items() for name in table]
    unprobed = [name for name in commands if not any(case.startswith(f"{name} ") for case in CASES)]
    assert not unprobed


def check(code: int, out: str, err: str, expected: str, seconds: float) -> None:
    assert code in (1, 2), (code, out, err)
    assert "Traceback" not in err + out
    assert 1 <= err.count("\n") <= 2 and err.startswith("manyeyes: "), err
    assert expected.lower() in err.lower(), err
    assert seconds < MAX_SECONDS


@pytest.mark.parametrize("case", CASES)
def test_a_bad_command_line_is_one_line(
    case: str,
    files: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MANYEYES_CACHE", str(tmp_path / "cache"))
    line, _, expected = (part.strip().format(**files) for part in case.partition(" | "))
    capsys.readouterr()
    signal.signal(signal.SIGALRM, lambda number, frame: pytest.fail(f"{line} runs on"))
    signal.alarm(MAX_SECONDS)
    start = time.monotonic()
    try:
        code = cli.main(shlex.split(line))
    finally:
        signal.alarm(0)
    seconds = time.monotonic() - start
    output = capsys.readouterr()
    check(code, str(output.out), str(output.err), expected, seconds)


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_a_bad_command_line_is_one_line_of_a_process(case: str, files: dict[str, Path], tmp_path: Path) -> None:
    line, _, expected = (part.strip().format(**files) for part in case.partition(" | "))
    environment = os.environ | {"MANYEYES_CACHE": str(tmp_path / "cache")}
    command = [sys.executable, "-m", "manyeyes.cli.main", *shlex.split(line)]
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path, env=environment, timeout=120, check=False
    )
    check(done.returncode, done.stdout, done.stderr, expected, 0.0)
