# SPDX-License-Identifier: Apache-2.0
"""Traffic on a road network by SUMO, one child process a simulation, the same for the same seed."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manyeyes.datatypes import LABELS, ConfigError, MissingExtraError
from manyeyes.maps.roads.road_network import RoadNetwork
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.simulator.scene.directions import direction
from manyeyes.simulator.scene.parking import parked_cars
from manyeyes.simulator.scene.towns import run_sumo_tool
from manyeyes.simulator.scene.vehicle_market import CLASSIC_MARKET, VehicleMarket, draw_vehicles
from manyeyes.simulator.scene.vehicles import VehicleStates, overlaps

Array = NDArray[np.float64]

_WORKER = Path(__file__).with_name("sumo_worker.py")
# Coordinates stay OpenDRIVE's; crossings of roads become junctions as the file has them; signals stand where the file has some.
_NETCONVERT = (
    "--offset.disable-normalization", "true",
    "--opendrive.import-all-lanes", "false",
    "--tls.guess-signals", "true",
    "--tls.guess", "true",
    "--tls.default-type", "actuated",
    "--junctions.join", "false",
    "--no-turnarounds", "true",
    "--default.lanewidth", "3.5",
    "--junctions.internal-link-detail", "16",
    "--junctions.limit-turn-speed", "3",
)  # fmt: skip
# Part of the cache's key: raise it when _for_traffic changes.
_CONVERSION = 1
_MAX_SPEED_MPS = 16.7
_TRUCK_SPEED_MPS = 22.0
_TRAIL_S = 20.0
_TOUCH_MARGIN_M = 0.02
# Way between the front bumper and the rear axle, in lengths.
_REAR_AXLE = 0.8
_LATERAL_SIGMA_M, _LATERAL_LIMIT_M = 0.12, 0.3


@dataclass(frozen=True, eq=False)
class _DrivableEdges:
    """What motor traffic can use of a SUMO net: names, lengths in m, lanes, limits in m/s and, per edge, which follow it."""

    name: tuple[str, ...]
    length: Array
    lanes: NDArray[np.int64]
    limit: Array
    following: tuple[tuple[int, ...], ...]


def simulate_traffic(
    network: RoadNetwork,
    seed: int,
    steps: int,
    step_s: float = 0.1,
    vehicles_per_lane_km: float = 9.0,
    warmup_s: float = 60.0,
    lead_steps: int = 0,
    market: VehicleMarket = CLASSIC_MARKET,
) -> tuple[VehicleStates, ...]:
    """Moving and waiting vehicles of the whole network, one VehicleStates a step, after warmup_s of driving.

    Each vehicle walks the net at random, far enough not to arrive before the end. lead_steps:
    the last so many steps of the warm-up come first; the others stay as they are. market: which vehicles drive.
    """
    if steps < 1 or step_s <= 0 or not 0 <= lead_steps * step_s <= warmup_s:
        raise ConfigError(
            "simulate_traffic needs steps >= 1, step_s > 0 and 0 <= lead * step_s <= warmup_s; got "
            f"{steps}, {step_s}, {lead_steps} and {warmup_s}."
        )
    net = sumo_net(network)
    edges = _read_edges(net)
    wanted = round(vehicles_per_lane_km * float((edges.length * edges.lanes).sum()) / 1000)
    random = keyed_generator(seed, "traffic", network.name)
    kind, size = draw_vehicles(random, wanted, market)
    with tempfile.TemporaryDirectory(prefix="manyeyes-sumo-") as folder:
        routes = Path(folder) / "routes.rou.xml"
        _write_routes(routes, edges, kind, size, random, duration_s=warmup_s + steps * step_s)
        arguments = [
            "--net-file", str(net), "--route-files", str(routes), "--step-length", repr(step_s),
            "--seed", str(int(random.integers(2**31 - 1))), "--lanechange.duration", "3",
            "--time-to-teleport", "-1", "--collision.action", "none", "--no-step-log", "true",
            "--no-warnings", "true", "--duration-log.disable", "true", "--default.action-step-length", repr(step_s),
        ]  # fmt: skip
        output = Path(folder) / "states.npz"
        before = min(max(lead_steps, round(_TRAIL_S / step_s)), round(warmup_s / step_s))
        skipped = round(warmup_s / step_s) - before
        job = {"arguments": arguments, "warmup_steps": skipped, "steps": steps + before, "output": str(output)}
        _run_worker(Path(folder) / "job.json", job)
        with np.load(output) as states:
            step, vehicle, state = states["step"], states["vehicle"], states["state"]
    heading = _headings(vehicle, state, size[:, 0])
    lateral_offset = np.clip(random.normal(0.0, _LATERAL_SIGMA_M, wanted), -_LATERAL_LIMIT_M, _LATERAL_LIMIT_M)
    shown = step >= before - lead_steps
    everything = _to_states(network, vehicle[shown], state[shown], heading[shown], kind, size, lateral_offset)
    everything = replace(everything, speed=_speeds(step, vehicle, state, step_s)[shown])
    frames = tuple(everything[step[shown] == before + k] for k in range(-lead_steps, steps))
    touching = np.unique(np.concatenate([_find_touching(frame) for frame in frames[lead_steps:]]))
    return tuple(frame[~np.isin(frame.id, touching)] for frame in frames)


def sumo_net(network: RoadNetwork) -> Path:
    """Return the network converted for SUMO, made once and kept in the cache folder by the content's hash."""
    version = _sumo_version()
    key = hashlib.blake2b(network.xodr, digest_size=12)
    key.update(repr((version, _NETCONVERT, _CONVERSION)).encode())
    folder = cache_folder()
    net = folder / f"{key.hexdigest()}.net.xml"
    if net.is_file():
        return net
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="netconvert-", dir=folder) as temporary:
        xodr, made = Path(temporary) / "roads.xodr", Path(temporary) / "roads.net.xml"
        xodr.write_bytes(_for_traffic(network.xodr))
        run_sumo_tool("netconvert", "--opendrive-files", str(xodr), "--output-file", str(made), *_NETCONVERT)
        made.replace(net)
    return net


def _for_traffic(xodr: bytes) -> bytes:
    """Return the same roads as SUMO shall drive them: parking and two-way turning lanes closed, and each lane's speed limit
    stated.

    SUMO would drive on parking lanes and take 50 km/h for every road. The CARLA towns allow up to 105 km/h into their
    crossings, so that limits are cut at 60 km/h.
    """
    root = ET.fromstring(xodr)
    for road in root.findall("road"):
        speed = road.find("type/speed")
        unit = {"mph": 0.44704, "km/h": 1 / 3.6}.get(speed.get("unit", "m/s"), 1.0) if speed is not None else 1.0
        stated = (speed.get("max") if speed is not None else None) or ""
        for lane in road.iter("lane"):
            if lane.get("type") in ("parking", "bidirectional"):
                lane.set("type", "none")
            elif lane.get("type") == "driving" and lane.find("speed") is None and stated.replace(".", "", 1).isdigit():
                limit = min(float(stated) * unit, _MAX_SPEED_MPS)
                ET.SubElement(lane, "speed", sOffset="0", max=f"{limit:.2f}", unit="m/s")
    return ET.tostring(root)


def cache_folder() -> Path:
    """Where converted networks are kept: $MANYEYES_CACHE, else the user's cache folder."""
    if os.environ.get("MANYEYES_CACHE"):
        return Path(os.environ["MANYEYES_CACHE"]) / "sumo"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "manyeyes" / "sumo"


def _sumo_version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("eclipse-sumo")
    except PackageNotFoundError as error:
        raise MissingExtraError("sim", "traffic") from error


def _read_edges(net: Path) -> _DrivableEdges:
    """Return edges that cars may use and what follows each, in the file's order."""
    root = ET.parse(net).getroot()
    name, length, lanes, limit = [], [], [], []
    for edge in root.findall("edge"):
        if edge.get("function") is not None:
            continue
        usable = [lane for lane in edge.findall("lane") if _admits_cars(lane)]
        if usable:
            name.append(edge.get("id", ""))
            length.append(float(usable[0].get("length", "0")))
            lanes.append(len(usable))
            limit.append(float(usable[0].get("speed", "13.9")))
    if not name:
        raise ConfigError(f"{net.name}: SUMO found no edge that cars may use; the roads have no drivable lanes.")
    place = {edge: k for k, edge in enumerate(name)}
    following: list[set[int]] = [set() for _ in name]
    for connection in root.findall("connection"):
        one, two = place.get(connection.get("from", "")), place.get(connection.get("to", ""))
        if one is not None and two is not None:
            following[one].add(two)
    ordered = tuple(tuple(sorted(after)) for after in _without_dead_ends(following))
    return _DrivableEdges(tuple(name), np.array(length), np.array(lanes, np.int64), np.array(limit), ordered)


def _without_dead_ends(following: list[set[int]]) -> list[set[int]]:
    """Return the same without dead ends, so that no vehicle vanishes on the road; unchanged where every edge is one."""
    kept, lost = [set(after) for after in following], set()
    while True:
        ends = {k for k, after in enumerate(kept) if not after} - lost
        if not ends:
            return kept if len(lost) < len(kept) else following
        lost |= ends
        for after in kept:
            after -= ends


def _admits_cars(lane: ET.Element) -> bool:
    allow, disallow = lane.get("allow"), lane.get("disallow")
    if allow is not None:
        return "passenger" in allow.split() or allow == "all"
    return disallow is None or not ({"all", "passenger"} & set(disallow.split()))


def _write_routes(
    path: Path,
    edges: _DrivableEdges,
    kind: NDArray[np.int64],
    size: Array,
    random: np.random.Generator,
    duration_s: float,
) -> None:
    """A type, a route and a vehicle for each of N; all start within the first seconds, anywhere on their first edge."""
    weights = edges.length * edges.lanes * np.array([bool(after) for after in edges.following])
    weights = weights if weights.any() else edges.length
    start = random.choice(len(edges.name), len(kind), p=weights / weights.sum())
    eager = np.clip(random.normal(1.0, 0.12, len(kind)), 0.7, 1.35)
    depart = np.sort(random.random(len(kind)) * min(5.0, duration_s / 2))
    root = ET.Element("routes")
    for n in range(len(kind)):
        label = LABELS[kind[n]]
        heavy = label in ("truck", "bus")
        length, width, height = (f"{v:.3f}" for v in size[n])
        ET.SubElement(
            root, "vType", id=f"t{n}", length=length, width=width, height=height, speedFactor=f"{eager[n]:.3f}",
            vClass={"van": "delivery", "truck": "truck", "bus": "bus"}.get(label, "passenger"),
            accel="1.2" if heavy else "2.4", decel="4.0" if heavy else "4.5", minGap="2.5", sigma="0.4",
            maxSpeed=f"{_TRUCK_SPEED_MPS if heavy else 50.0}", lcMaxSpeedLatStanding="0", lcMaxSpeedLatFactor="0.25",
        )  # fmt: skip
        vehicle = ET.SubElement(
            root, "vehicle", id=str(n), type=f"t{n}", depart=f"{depart[n]:.2f}", departLane="best",
            departPos="random_free", departSpeed="max",
        )  # fmt: skip
        ET.SubElement(vehicle, "route", edges=" ".join(_walk(edges, int(start[n]), random, duration_s * eager[n])))
    ET.ElementTree(root).write(path, encoding="utf-8")


def _walk(edges: _DrivableEdges, start: int, random: np.random.Generator, seconds: float) -> list[str]:
    """Return edges from start, each drawn among those that follow, until driving them at the limit takes longer than
    ``seconds``.
    """
    here, route, left = start, [start], seconds + 20.0
    while left > 0 and edges.following[here]:
        here = int(random.choice(edges.following[here]))
        route.append(here)
        left -= edges.length[here] / edges.limit[here]
    return [edges.name[k] for k in route]


def _run_worker(path: Path, job: dict[str, object]) -> None:
    """The simulation in a child process; its last line of complaint becomes the error."""
    path.write_text(json.dumps(job))
    done = subprocess.run([sys.executable, str(_WORKER), str(path)], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        if "libsumo is not installed" in done.stderr:
            raise MissingExtraError("sim", "traffic")
        lines = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
        raise ConfigError(f"SUMO failed with {done.returncode}: {lines[-1][:300] if lines else 'no output'}")


def _headings(vehicle: NDArray[np.int64], state: Array, length: Array) -> Array:
    """Return (rows,) headings in radians: from where the front bumper was one wheelbase of way ago to where it is now.

    SUMO's own angle swings a whole bus by the direction of its bumper while it changes lanes; following the bumper's
    track keeps the rear on it. Before the record began the track goes straight back along SUMO's angle.
    """
    heading = np.empty(len(vehicle))
    order = np.argsort(vehicle, kind="stable")
    names, first = np.unique(vehicle[order], return_index=True)
    for name, rows in zip(names, np.split(order, first[1:])):
        front = state[rows, :2]
        reach = _REAR_AXLE * length[name]
        initial = np.pi / 2 - np.radians(state[rows[0], 3])
        start = front[0] - reach * np.array([np.cos(initial), np.sin(initial)])
        track = np.concatenate((start[None], front))
        way = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(track, axis=0), axis=1))))
        rear = np.stack([np.interp(way[1:] - reach, way, track[:, k]) for k in (0, 1)], -1)
        delta = front - rear
        heading[rows] = direction(delta[:, 1], delta[:, 0])
    return heading


def _speeds(step: NDArray[np.int64], vehicle: NDArray[np.int64], state: Array, step_s: float) -> Array:
    """Return (rows,) way of the front bumper since the step before over its time; SUMO's speed where there is no such step.

    They differ where the lanes of one edge have unequal lengths: SUMO moves along all of them as if along their mean.
    """
    order = np.lexsort((step, vehicle))
    follows = (np.diff(vehicle[order]) == 0) & (np.diff(step[order]) == 1)
    way = np.linalg.norm(np.diff(state[order, :2], axis=0), axis=1) / step_s
    speed = state[:, 4].copy()
    speed[order[1:]] = np.where(follows, way, speed[order[1:]])
    return speed


def _find_touching(frame: VehicleStates) -> NDArray[np.int64]:
    """Return ids of vehicles that overlap one with a smaller id: SUMO lets corners touch where tracks meet at an angle."""
    corners, found = frame.corners(_TOUCH_MARGIN_M), []
    reach = np.linalg.norm(frame.size[:, :2], axis=1) / 2
    for n in range(1, len(frame)):
        near = np.linalg.norm(frame.position[:n, :2] - frame.position[n, :2], axis=1) < reach[:n] + reach[n]
        close = near & (np.abs(frame.position[:n, 2] - frame.position[n, 2]) < 2.0)
        if close.any() and overlaps(corners[n], corners[:n][close]).any():
            found.append(frame.id[n])
    return np.array(found, np.int64)


def _to_states(
    network: RoadNetwork,
    vehicle: NDArray[np.int64],
    state: Array,
    yaw: Array,
    kind: NDArray[np.int64],
    size: Array,
    lateral_offset: Array,
) -> VehicleStates:
    """SUMO's front bumpers as footprints on the road.

    lateral_offset: (vehicles,) metres left of the lane's middle that each keeps. Wheels stand at 0.3 lengths before and behind
    the middle; their heights give pitch and z.
    """
    size, kind, lateral_offset = size[vehicle], kind[vehicle], lateral_offset[vehicle]
    ahead = np.stack((np.cos(yaw), np.sin(yaw)), -1)
    left = np.stack((-ahead[:, 1], ahead[:, 0]), -1)
    middle = state[:, :2] - ahead * size[:, :1] / 2 + left * lateral_offset[:, None]
    base = size[:, :1] * 0.3
    surface = network.drivable_surface
    front = surface.height(middle + ahead * base, state[:, 2])
    rear = surface.height(middle - ahead * base, state[:, 2])
    position = np.concatenate((middle, (front + rear)[:, None] / 2), -1)
    pitch = -direction(front - rear, 2 * base[:, 0])
    return VehicleStates(vehicle, kind, position, yaw, pitch, state[:, 4], size)


__all__ = ["VehicleStates", "cache_folder", "parked_cars", "simulate_traffic", "sumo_net"]
