# SPDX-License-Identifier: Apache-2.0
"""One drive at a crossing: traffic, connected vehicles, a roadside unit, and what each of them senses at each instant."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import (
    VEHICLE_LABELS,
    AgentBody,
    AgentFrame,
    Boxes,
    ConfigError,
    GroundTruth,
    PointCloud,
    Snapshot,
    Transform,
)
from manyeyes.maps.roads.road_network import Junction, RoadNetwork
from manyeyes.ops.keyed_random import keyed_generator
from manyeyes.ops.lidar.intensity import INTENSITY_LAWS
from manyeyes.ops.raycast import HeightField, Primitives
from manyeyes.simulator.scene.body_styles import make_market_shape
from manyeyes.simulator.scene.environment import environment_spec
from manyeyes.simulator.scene.ground import GroundRaster, build_ground, is_multilevel
from manyeyes.simulator.scene.parking import parked_cars
from manyeyes.simulator.scene.placement import PlacementGrid
from manyeyes.simulator.scene.roadside_objects import find_pole_sites, make_pole
from manyeyes.simulator.scene.surroundings import place_surroundings
from manyeyes.simulator.scene.terrain import add_terrain, stand_on_ground
from manyeyes.simulator.scene.traffic import simulate_traffic
from manyeyes.simulator.scene.vehicle_shapes import (
    VehicleShape,
    box_centers,
    place_vehicle_shapes,
    rotation_from_yaw_pitch,
)
from manyeyes.simulator.scene.vehicles import VehicleStates
from manyeyes.simulator.sensors.camera import CameraSpec, LitScene, camera_rig, render_image
from manyeyes.simulator.sensors.lidar import RaycastScene, scan
from manyeyes.simulator.sensors.lidar_spec import LidarSpec
from manyeyes.simulator.sensors.lidars import lidar_spec
from manyeyes.simulator.sensors.lighting import draw_light
from manyeyes.simulator.sensors.materials import Materials, make_static_materials, make_vehicle_materials
from manyeyes.simulator.sensors.sensor_mix import sensor_mix

Array = NDArray[np.float64]

RSU_ID = -1
_HALF_SIZE_M = 180.0
_NEAR_M = 60.0
_LEVEL_GAP_M = 1.0
_MOVED_M = 0.2


@dataclass(frozen=True)
class ScenarioSpec:
    """Specification of a scenario; the rest follows from the seed.

    vehicles: connected vehicles, each at least min_gap_m from the others and within low_m … high_m of the crossing at the first
    frame. frames: at rate_hz, the first history_frames of which are not evaluated. lead_frames: additional frames before the
    first, with traffic under way. They leave the frames after them unchanged, except where a connected vehicle was not on the
    road yet: then others are drawn. roadside_chance: probability of a roadside unit. density: of the traffic, in units of 9
    vehicles per kilometre of lane. min_vehicles: within 60 m of the crossing, or another crossing is drawn. clutter: factor on
    the numbers of RoadsideObjectSpec. cameras, roadside_cameras: names of CAMERA_RIGS, of each vehicle and of the unit, at its
    LiDAR's height. intensity: a name of INTENSITY_LAWS, of all sensors; None for each sensor's own law. sensor_mix: a name of
    SENSOR_MIXES, from which the sensor of each agent is drawn; "none" for lidar and roadside_lidar as they are. environment:
    name of a world in ENVIRONMENTS.
    """

    town: str
    seed: int
    name: str
    vehicles: int = 3
    frames: int = 16
    history_frames: int = 6
    lead_frames: int = 0
    rate_hz: float = 10.0
    roadside_chance: float = 0.7
    lidar: str = "opv2v"
    roadside_lidar: str = "opv2v-roadside"
    density: float = 4.0
    low_m: float = 8.0
    high_m: float = 45.0
    min_gap_m: float = 9.0
    min_vehicles: int = 16
    clutter: float = 1.0
    cameras: str = "none"
    roadside_cameras: str = "none"
    intensity: str | None = None
    sensor_mix: str = "none"
    environment: str = "classic"

    def __post_init__(self) -> None:
        if not (1 <= self.vehicles <= 6 and self.frames > self.history_frames >= 0 <= self.lead_frames):
            raise ConfigError(
                f"ScenarioSpec needs 1 … 6 vehicles, frames > history_frames >= 0 and lead_frames >= 0; got {self}."
            )
        if not 0 <= self.low_m < self.high_m:
            raise ConfigError(f"ScenarioSpec needs 0 <= low_m < high_m; got {self}.")
        if self.intensity is not None and self.intensity not in INTENSITY_LAWS:
            raise ConfigError(f"No intensity law '{self.intensity}'; choose one of {', '.join(INTENSITY_LAWS)}.")

    def agent_lidar(self, agent: int) -> LidarSpec:
        """Return the sensor of a vehicle, or of the roadside unit (agent < 0), with its mounting and its law."""
        if self.sensor_mix == "none":
            lidar = lidar_spec(self.roadside_lidar if agent < 0 else self.lidar)
        else:
            lidar = sensor_mix(self.sensor_mix).draw(agent < 0, self.rate_hz, (self.seed, self.name, agent))
        return lidar if self.intensity is None else replace(lidar, intensity=INTENSITY_LAWS[self.intensity])


class NoSceneError(ConfigError):
    """No crossing of the drawn traffic fits the specification; another seed may."""


@dataclass(frozen=True, eq=False)
class RoadsideUnit:
    """A unit on a pole: its upright frame on the road under it, facing the crossing, and its sensors, which may be tilted."""

    world_from_agent: Transform
    lidar: LidarSpec
    cameras: tuple[CameraSpec, ...] = ()


@dataclass(frozen=True, eq=False)
class SimulatedScenario:
    """All that is fixed before the first frame. states: one a frame, moving and parked vehicles alike, same ids throughout
    where they stay near. agents: ids of the connected vehicles. static_solids: what does not move; solids of vehicles come on
    top."""

    spec: ScenarioSpec
    network: RoadNetwork
    ground: HeightField
    static_solids: Primitives
    states: tuple[VehicleStates, ...]
    shapes: dict[int, VehicleShape]
    agents: tuple[int, ...]
    roadside: RoadsideUnit | None
    crossing: Array

    def __len__(self) -> int:
        return len(self.states)

    @property
    def moving_fraction(self) -> float:
        """Share of the first frame's vehicles that are elsewhere in the last; frames of the lead do not count."""
        return float(_find_moving(self.states[self.spec.lead_frames :]).mean())

    def lidar(self, agent: int) -> LidarSpec:
        """Return the sensor of an agent."""
        return self.roadside.lidar if agent < 0 and self.roadside is not None else self.spec.agent_lidar(agent)

    def snapshot(self, index: int) -> Snapshot:
        """What every agent senses at one instant, and the truth: prior poses are the true ones."""
        states, spec = self.states[index], self.spec
        scene, boxes = self.scene(index), true_boxes(states)
        rig = camera_rig(spec.cameras)
        lit_scene = self.lit_scene(index) if {spec.cameras, spec.roadside_cameras} != {"none"} else None
        time_ns = round(index * 1e9 / spec.rate_hz)
        drawn_ms = round((index - spec.lead_frames) * 1e3 / spec.rate_hz)
        frames, visible = [], []
        for agent in self.agents:
            row = int(np.flatnonzero(states.id == agent)[0])
            speed = float(states.speed[row])
            frame, own_visible = self._sense(
                scene, agent, _pose(states, row), self.lidar(agent), boxes, (time_ns, drawn_ms), speed
            )
            frames.append(_with_images(frame, lit_scene, rig))
            visible.append(own_visible)
        if self.roadside is not None:
            unit = self.roadside
            frame, own_visible = self._sense(
                scene, RSU_ID, unit.world_from_agent, unit.lidar, boxes, (time_ns, drawn_ms), 0.0
            )
            frames.append(_with_images(frame, lit_scene, unit.cameras))
            visible.append(own_visible)
        truth = GroundTruth(boxes, torch.stack(visible), Transform.stack([f.world_from_agent for f in frames]))
        return Snapshot(spec.name, index, tuple(frames), truth)

    def scene(self, index: int) -> RaycastScene:
        """Return all that rays can meet at one instant."""
        states = self.states[index]
        moving = place_vehicle_shapes(
            [self.shapes[int(i)] for i in states.id],
            states.position,
            states.yaw,
            states.pitch,
            states.id,
            states.roll,
        )
        return RaycastScene(Primitives.cat([self.static_solids, moving]), self.ground)

    def lit_scene(self, index: int) -> LitScene:
        """Return the scene at one instant as cameras see it."""
        seed = self.spec.seed
        materials = Materials.cat(
            [
                make_static_materials(self.static_solids, seed),
                make_vehicle_materials(self.states[index], self.shapes, seed),
            ]
        )
        return LitScene.of(self.scene(index), materials, draw_light(seed, self.spec.name))

    def _sense(
        self,
        scene: RaycastScene,
        agent: int,
        mount: Transform,
        lidar: LidarSpec,
        boxes: Boxes,
        time: tuple[int, int],
        speed: float,
    ) -> tuple[AgentFrame, torch.Tensor]:
        """Return one agent's frame, and which boxes it sees.

        mount: the frame on the road that its sensor stands on; the agent's frame is tilted as the sensor is. time: its own in ns,
        and that which draws are keyed by in ms.
        """
        time_ns, drawn_ms = time
        seed, name = self.spec.seed, self.spec.name
        pose = lidar.agent_pose(mount)
        points, instance = scan(scene, pose, lidar, (seed, name, drawn_ms, agent), agent, (seed, name, "sensor", agent))
        frame = AgentFrame(
            agent_id=agent,
            timestamp_ns=time_ns,
            points=points,
            world_from_agent=pose,
            pose_covariance=torch.zeros(3, 3, dtype=torch.float64),
            sensor_height_m=lidar.height_m,
            speed_mps=speed,
            is_infrastructure=agent < 0,
            body=_own_body(boxes, agent, pose),
        )
        return frame, find_visible_boxes(points, instance, pose, boxes, agent)


def _own_body(boxes: Boxes, agent: int, world_from_agent: Transform) -> AgentBody | None:
    """Return the vehicle of an agent in its frame; None of a roadside unit."""
    own = boxes[boxes.id == agent].transform(world_from_agent.inverse())
    if not len(own):
        return None
    (x, y, z), (length, width, height) = own.center[0].tolist(), own.size[0].tolist()
    return AgentBody((x, y, z), (length, width, height), float(own.yaw[0]))


def _with_images(frame: AgentFrame, lit_scene: LitScene | None, rig: tuple[CameraSpec, ...]) -> AgentFrame:
    if lit_scene is None:
        return frame
    pictures = (render_image(lit_scene, frame.world_from_agent, camera, own=frame.agent_id) for camera in rig)
    return replace(frame, images=tuple(picture.image for picture in pictures))


def true_boxes(states: VehicleStates) -> Boxes:
    """Return the vehicles' boxes in the world frame, float64."""
    center = box_centers(states.position, states.yaw, states.pitch, states.size[:, 2], states.roll)
    place = torch.from_numpy(center), torch.from_numpy(states.size), torch.from_numpy(states.yaw)
    return Boxes.of(*place, label=torch.from_numpy(states.kind), id=torch.from_numpy(states.id))


def find_visible_boxes(
    points: PointCloud, instance: NDArray[np.int64], pose: Transform, boxes: Boxes, own: int
) -> torch.Tensor:
    """Return (N,) bool: boxes with at least one return of that vehicle inside (5 cm margin); never the agent's own."""
    met = torch.from_numpy(np.flatnonzero((instance > 0) & (instance != own)))
    visible = torch.zeros(len(boxes), dtype=torch.bool)
    # Each return is asked of its own vehicle's box alone.
    by_id = boxes.id.argsort()
    row = by_id[torch.searchsorted(boxes.id[by_id], torch.from_numpy(instance)[met])]
    local = boxes.transform(pose.inverse()).to(torch.float32)
    delta = points.xyz[met] - local.center[row]
    c, s = local.yaw.cos()[row], local.yaw.sin()[row]
    half = local.size[row] / 2 + 0.05
    inside = (delta[:, 0] * c + delta[:, 1] * s).abs() <= half[:, 0]
    inside &= (delta[:, 1] * c - delta[:, 0] * s).abs() <= half[:, 1]
    inside &= delta[:, 2].abs() <= half[:, 2]
    visible[row[inside]] = True
    return visible


def _pose(states: VehicleStates, row: int) -> Transform:
    rotation = rotation_from_yaw_pitch(*(angle[row : row + 1] for angle in (states.yaw, states.pitch, states.roll)))[0]
    return Transform(torch.from_numpy(rotation), torch.from_numpy(states.position[row].copy()))


def to_height_field(ground: GroundRaster) -> HeightField:
    """Return the ground as rays see it."""
    return HeightField(ground.height, ground.surface, ground.x0, ground.y0, ground.cell_m, ground.surface_cell_m)


def make_scenario(spec: ScenarioSpec, network: RoadNetwork) -> SimulatedScenario:
    """Traffic of the whole town, one busy crossing of it, agents among the vehicles there, and what stands around.

    Raises NoSceneError where no crossing has enough traffic; at least the environment's fraction of the vehicles near the
    chosen one moves.
    """
    world = environment_spec(spec.environment)
    random = keyed_generator(spec.seed, "scenario", spec.town)
    # Dense traffic jams when it runs for long, and most signals of a town turn red together at 25 s.
    warmup_s = round(float(random.uniform(8.0, 15.0)), 1)
    lead = spec.lead_frames
    traffic = simulate_traffic(
        network, spec.seed, spec.frames, 1 / spec.rate_hz, 9.0 * spec.density, warmup_s, lead, world.market
    )
    # SUMO counts from 0, which is the instance of what is not a vehicle.
    traffic = tuple(replace(states, id=states.id + 1) for states in traffic)
    for junction in _crossings(network, traffic[lead:], spec, random):
        middle = np.asarray(junction.center[:2], np.float64)
        agents = _choose_agents(traffic[lead:], middle, spec, random)
        near = tuple(s[np.hypot(*(s.position[:, :2] - middle).T) < _HALF_SIZE_M - 10.0] for s in traffic)
        if len(agents) < spec.vehicles or not all((s.id == a).any() for a in agents for s in near):
            continue
        # Cheap refusals before the ground is drawn: a jam, and roads over roads.
        if _find_moving(near[lead:]).mean() < world.min_moving_fraction or is_multilevel(
            network, middle, 1.5 * _NEAR_M
        ):
            continue
        field = to_height_field(build_ground(network, middle, _HALF_SIZE_M))
        plot = PlacementGrid.of(field)
        states = tuple(s[np.abs(plot.height(s.position[:, :2]) - s.position[:, 2]) < _LEVEL_GAP_M] for s in near)
        taken = float(random.uniform(*world.parked_fraction))
        parked = parked_cars(network, spec.seed, middle, 110.0, taken, world.market)
        parked = _select_parked(states[lead:], parked, world.min_moving_fraction, random)
        states = tuple(VehicleStates.cat([now, parked]) for now in states)
        if not all((s.id == a).any() for a in agents for s in states):
            continue
        if _find_moving(states[lead:]).mean() < world.min_moving_fraction:
            continue
        if not world.other_vehicles:
            states = tuple(now[np.isin(now.id, agents)] for now in states)
        if world.terrain is not None:
            field = add_terrain(field, world.terrain, middle, (spec.seed, spec.town))
            plot = replace(plot, ground=field)
            states = tuple(stand_on_ground(now, field) for now in states)
        return _place_static_objects(spec, network, plot, states, agents, middle, random)
    raise NoSceneError(
        f"{spec.name}: no crossing in {spec.town} has {spec.min_vehicles} vehicles with {spec.vehicles} cars to connect "
        f"at seed {spec.seed}; another seed or a higher density may."
    )


def _find_moving(states: tuple[VehicleStates, ...]) -> NDArray[np.bool_]:
    """Return (N,) of the first instant: whether a vehicle is elsewhere at the last one; who left the scene moved."""
    last = {int(i): row for row, i in enumerate(states[-1].id)}
    moved = np.ones(len(states[0]), bool)
    for row, id in enumerate(states[0].id.tolist()):
        if id in last:
            moved[row] = np.linalg.norm(states[-1].position[last[id]] - states[0].position[row]) > _MOVED_M
    return moved


def _crossings(
    network: RoadNetwork, traffic: tuple[VehicleStates, ...], spec: ScenarioSpec, random: np.random.Generator
) -> list[Junction]:
    """Return crossings of three or more incoming lanes with enough vehicles near, in an order drawn by how many these are."""
    xy = traffic[0].position[:, :2]
    found = []
    for junction in network.junctions:
        count = int((np.hypot(*(xy - junction.center[:2]).T) < _NEAR_M).sum())
        luck = random.random()
        if len(junction.incoming) >= 3 and count >= spec.min_vehicles:
            found.append((luck ** (1.0 / count), junction))
    return [junction for _, junction in sorted(found, key=lambda pair: -pair[0])]


def _choose_agents(
    traffic: tuple[VehicleStates, ...], middle: Array, spec: ScenarioSpec, random: np.random.Generator
) -> tuple[int, ...]:
    """Return cars of the traffic around the crossing, drawn one after the other with a gap between any two."""
    first = traffic[0]
    distance = np.hypot(*(first.position[:, :2] - middle).T)
    present_throughout = np.ones(len(first), bool)
    for states in traffic[1:]:
        present_throughout &= np.isin(first.id, states.id)
    rows = np.flatnonzero((first.kind == 0) & (distance > spec.low_m) & (distance < spec.high_m) & present_throughout)
    chosen: list[int] = []
    for row in random.permutation(rows).tolist():
        gaps = np.linalg.norm(first.position[chosen, :2] - first.position[row, :2], axis=-1)
        if len(chosen) < spec.vehicles and (gaps > spec.min_gap_m).all():
            chosen.append(row)
    return tuple(sorted(first.id[chosen].tolist()))


def _select_parked(
    states: tuple[VehicleStates, ...], parked: VehicleStates, min_moving_fraction: float, random: np.random.Generator
) -> VehicleStates:
    """Some of the parked cars, at most so many that the given fraction of all vehicles moves."""
    moving = _find_moving(states)
    room = max(0, int(moving.sum() / min_moving_fraction - len(moving)))
    return parked[np.sort(random.permutation(len(parked))[:room])]


def _place_static_objects(
    spec: ScenarioSpec, network: RoadNetwork, plot: PlacementGrid, states: tuple[VehicleStates, ...],
    agents: tuple[int, ...], middle: Array, random: np.random.Generator,
) -> SimulatedScenario:  # fmt: skip
    """Return a roadside unit and everything that stands still, put around vehicles that are already there."""
    drawn, world = states[spec.lead_frames], environment_spec(spec.environment)
    still = drawn[drawn.speed == 0]
    for position, size, yaw in zip(still.position, still.size, still.yaw):
        plot.occupy(position[:2], (float(size[0]) / 2 + 0.5, float(size[1]) / 2 + 0.5), float(yaw))
    roadside, solids, poles = None, [], np.zeros((0, 2))
    if random.random() < spec.roadside_chance:
        roadside = _roadside(plot, middle, spec, random)
    if roadside is not None:
        xyz = roadside.world_from_agent.translation.numpy()
        plot.occupy(xyz[:2], (1.0, 1.0), 0.0)
        poles = xyz[None, :2]
        solids.append(make_pole(xyz[:2], float(xyz[2]), roadside.lidar.height_m - 0.3, RSU_ID))
    setback_m = float(random.uniform(1.5, 6.0))
    solids.append(place_surroundings(plot, world, spec.clutter, setback_m, middle, states, poles, (spec.seed,)))
    shapes: dict[int, VehicleShape] = {}
    for now in states:
        for id, kind, size in zip(now.id.tolist(), now.kind.tolist(), now.size.tolist()):
            if id not in shapes:
                shapes[id] = make_market_shape(world.market, VEHICLE_LABELS[kind], tuple(size), spec.seed, id)
    return SimulatedScenario(
        spec, network, plot.ground, Primitives.cat(solids), states, shapes, agents, roadside, middle
    )


def _roadside(
    plot: PlacementGrid, middle: Array, spec: ScenarioSpec, random: np.random.Generator
) -> RoadsideUnit | None:
    """Return a pole beside the carriageway near the crossing, facing it, 4.5 to 6 m high; None where there is no place."""
    places = find_pole_sites(plot, middle)
    if not len(places):
        return None
    xy = places[int(random.integers(min(len(places), 150)))]
    toward = middle - xy
    pose = Transform.from_xyz_yaw(float(xy[0]), float(xy[1]), float(plot.height(xy)), math.atan2(toward[1], toward[0]))
    height = float(random.uniform(4.5, 6.0))
    lidar = spec.agent_lidar(RSU_ID)
    if spec.sensor_mix == "none":
        lidar = replace(lidar, height_m=height)
    cameras = tuple(replace(camera, z_m=lidar.height_m) for camera in camera_rig(spec.roadside_cameras))
    return RoadsideUnit(pose, lidar, cameras)
