# SPDX-License-Identifier: Apache-2.0
"""Cameras in a scene: pictures of the solids and the ground that the LiDAR meets, textured, in sun and shade.

What a pixel meets is decided by ops/pinhole.py; here it gets its colour: the surface's own (simulator/sensors/texture.py), by
Lambert's law in the sun where no solid stands before it (simulator/sensors/shadow.py), in the light of the sky, with the sky's
reflection in lacquer and glass (Schlick's approximation), through haze. A picture is of one instant: no motion blur.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from manyeyes.datatypes import Camera, CameraImage, ConfigError, Transform
from manyeyes.ops.pinhole import PinholeCamera, cast_pinhole
from manyeyes.ops.raycast import BOX, CYLINDER, ELLIPSOID, GROUND, NOTHING, SensorPose
from manyeyes.simulator.sensors.lidar import RaycastScene
from manyeyes.simulator.sensors.lighting import Light, dot, tone_map
from manyeyes.simulator.sensors.materials import PAINTWORK, Materials
from manyeyes.simulator.sensors.shadow import ShadowIndex, build_shadow_index, sun_and_sky_visibility
from manyeyes.simulator.sensors.texture import SolidPoints, ground_rgb, solid_rgb

Array = NDArray[np.float64]
Real = NDArray[np.floating]

# Metres between a surface and where its shadow ray starts; how far about an edge of lacquer light bends. Chosen.
_OFF_M, _BEVEL_M = 0.01, 0.10
_MIRROR = 0.05


@dataclass(frozen=True)
class CameraSpec:
    """A pinhole on an agent.

    fx, fy, cx, cy: pixels of a picture of width x height. x_m ahead of and y_m to the left of the agent's origin, z_m
    above the road; yaw_rad to the left, pitch_rad downwards. samples: rays to a pixel along each axis, against jagged edges.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 1.8
    yaw_rad: float = 0.0
    pitch_rad: float = 0.0
    samples: int = 2
    max_depth_m: float = 400.0

    def __post_init__(self) -> None:
        if min(self.fx, self.fy, self.width, self.height, self.samples, self.max_depth_m) <= 0:
            raise ConfigError(f"CameraSpec needs positive focal lengths, sizes, samples and max_depth_m; got {self}.")

    @property
    def camera(self) -> Camera:
        """The camera in its agent's frame."""
        c, s, cp, sp = (
            math.cos(self.yaw_rad),
            math.sin(self.yaw_rad),
            math.cos(self.pitch_rad),
            math.sin(self.pitch_rad),
        )
        right, down, ahead = (s, -c, 0.0), (-c * sp, -s * sp, -cp), (c * cp, s * cp, -sp)
        rotation = torch.tensor([right, down, ahead], dtype=torch.float64).T
        place = torch.tensor([self.x_m, self.y_m, self.z_m], dtype=torch.float64)
        intrinsic = torch.tensor([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=torch.float64)
        return Camera(intrinsic, Transform(rotation, place), self.width, self.height)

    def resized(self, width: int, height: int) -> CameraSpec:
        """Return the same view on another number of pixels."""
        u, v = width / self.width, height / self.height
        return replace(self, fx=u * self.fx, fy=v * self.fy, cx=u * self.cx, cy=v * self.cy, width=width, height=height)

    def below(self, row: int) -> CameraSpec:
        """Return the same view without its rows above row."""
        return replace(self, cy=self.cy - row, height=self.height - row)


# opv2v: front, right, left and back, 100 degrees wide (intrinsics: recordings.md; places [x, y to the right, z, yaw to the
# right] [2.5, 0, 1.0, 0], [0, 0.3, 1.8, 100], [0, -0.3, 1.8, -100], [-2, 0, 1.5, 180] as OpenCDA, OPV2V's simulator, has them).
# dair-infrastructure: the intrinsics of a camera of DAIR-V2X's roadside units; its pitch is chosen.
_F = 335.639852470912
_OPV2V = tuple(
    CameraSpec(_F, _F, 400.0, 300.0, 800, 600, x, y, z, math.radians(yaw))
    for x, y, z, yaw in (
        (2.5, 0.0, 1.0, 0.0),
        (0.0, -0.3, 1.8, -100.0),
        (0.0, 0.3, 1.8, 100.0),
        (-2.0, 0.0, 1.5, 180.0),
    )
)
_DAIR = CameraSpec(
    2183.375019, 2329.297332, 940.590363, 567.568513, 1920, 1080, z_m=6.0, pitch_rad=math.radians(11), samples=1
)

CAMERA_RIGS: dict[str, tuple[CameraSpec, ...]] = {
    "none": (),
    "opv2v": _OPV2V,
    "opv2v-small": tuple(camera.resized(400, 300) for camera in _OPV2V),
    # From a little above the horizon downwards: what lies on the road.
    "opv2v-road": tuple(camera.resized(320, 240).below(104) for camera in _OPV2V),
    "dair-infrastructure": (_DAIR,),
    "dair-infrastructure-small": (replace(_DAIR.resized(480, 270), samples=2),),
    "dair-infrastructure-road": (replace(_DAIR.resized(320, 180), samples=2),),
}


def camera_rig(name: str) -> tuple[CameraSpec, ...]:
    """Return the cameras of an agent by their name in CAMERA_RIGS."""
    if name not in CAMERA_RIGS:
        raise ConfigError(f"No cameras '{name}'; choose one of {', '.join(CAMERA_RIGS)}.")
    return CAMERA_RIGS[name]


@dataclass(frozen=True, eq=False)
class LitScene:
    """A scene at one instant as cameras see it: its solids' materials, its light and what shades what."""

    scene: RaycastScene
    materials: Materials
    light: Light
    shadows: ShadowIndex

    @classmethod
    def of(cls, scene: RaycastScene, materials: Materials, light: Light) -> LitScene:
        """Return a stage, with the index of its shadows."""
        lowest = float(scene.ground.height.min())
        return cls(scene, materials, light, build_shadow_index(scene.solids, light.sun, lowest, light.seed))


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """An image, and what made it, per pixel's first ray: depth_m (height, width) along the axis, inf in the sky; instance
    (height, width): a vehicle's id (> 0), a pole's agent (< 0), 0 for anything else."""

    image: CameraImage
    depth_m: Array
    instance: NDArray[np.int64]


def render_image(lit_scene: LitScene, world_from_agent: Transform, spec: CameraSpec, own: int = 0) -> RenderedImage:
    """Return the picture of one camera. own: the instance that carries it, which is not seen but throws its shadow."""
    camera, n = spec.camera, spec.samples
    dense = camera.resize(n * camera.width, n * camera.height)
    world_from_camera = world_from_agent @ camera.agent_from_camera
    origin, rotation = world_from_camera.translation.numpy(), np.ascontiguousarray(world_from_camera.rotation.numpy())
    solids = lit_scene.scene.solids
    hits = cast_pinhole(
        solids,
        lit_scene.scene.ground,
        SensorPose(origin, rotation),
        PinholeCamera(dense.intrinsic.numpy(), dense.width, dense.height),
        spec.max_depth_m,
        lit_scene.light.seed,
        own,
    )
    # (pixels, n n): where all rays of a pixel meet the same thing, one through its middle has the colour of all.
    owner, depth = (_by_pixel(grid, n) for grid in (hits.primitive, hits.depth_m))
    one = (owner == owner[:, :1]).all(1)
    whole, split = np.flatnonzero(one), np.flatnonzero(~one)
    with np.errstate(divide="ignore"):  # the sky's depth is inf
        middle = 1 / (1 / depth[whole]).mean(1)  # exact on planes
    few, many = (_world_rays(rotation, c) for c in (camera, dense))
    many = _by_pixel(many, n)[split].reshape(-1, 3)
    rays = np.concatenate((few.reshape(-1, 3)[whole], many))
    pixel = float(2 / (camera.intrinsic[0, 0] + camera.intrinsic[1, 1]))
    pixels = np.concatenate((np.full(len(whole), pixel), np.full(len(many), pixel / n)))
    colour = tone_map(
        _shade(
            lit_scene, np.concatenate((owner[whole, 0], owner[split].ravel())),
            np.concatenate((middle, depth[split].ravel())), origin, rays, pixels,
        )
    )  # fmt: skip
    rgb = np.empty((camera.height * camera.width, 3), np.float32)
    rgb[whole] = colour[: len(whole)]
    rgb[split] = colour[len(whole) :].reshape(len(split), n * n, 3).mean(1)
    picture = torch.from_numpy(np.rint(255 * rgb).astype(np.uint8)).reshape(camera.height, camera.width, 3)
    first = owner[:, 0].reshape(camera.height, camera.width)
    instance = np.append(solids.instance, 0)[np.where(first >= 0, first, -1)]
    image = CameraImage(camera, picture.permute(2, 0, 1).contiguous())
    return RenderedImage(image, depth[:, 0].reshape(first.shape), instance)


def _by_pixel(grid: NDArray, n: int) -> NDArray:
    """Return (n height, n width, ...) as (height width, n n, ...)."""
    rows, columns, *more = grid.shape
    blocks = grid.reshape(rows // n, n, columns // n, n, *more)
    return blocks.swapaxes(1, 2).reshape(-1, n * n, *more)


def _world_rays(world_from_camera: Array, camera: Camera) -> Array:
    """Return (height, width, 3) of depth one, world axes; world_from_camera: (3, 3)."""
    k = camera.intrinsic.numpy()
    x = (np.arange(camera.width) + 0.5 - k[0, 2]) / k[0, 0]
    y = (np.arange(camera.height) + 0.5 - k[1, 2]) / k[1, 1]
    right, down, ahead = world_from_camera.T
    return x[None, :, None] * right + y[:, None, None] * down + ahead


def _shade(
    lit_scene: LitScene, owner: NDArray[np.int32], depth: Array, origin: Array, rays: Array, pixel: Array
) -> Real:
    """Radiance (N, 3). rays: (N, 3) world axes, of depth one; pixel: (N,) the width of one at a depth of one."""
    light = lit_scene.light
    length = np.linalg.norm(rays, axis=1)
    toward = (rays / length[:, None]).astype(np.float32)
    radiance = np.empty((len(rays), 3), np.float32)
    sky = np.flatnonzero(owner == NOTHING)
    radiance[sky] = light.sky_radiance(toward[sky])
    met = np.flatnonzero(owner != NOTHING)
    points = origin + depth[met, None] * rays[met]
    width = (pixel[met] * depth[met]).astype(np.float32)
    surface = _surfaces(lit_scene, owner[met], points, toward[met], width)
    lit, open_sky = sun_and_sky_visibility(lit_scene.shadows, points + _OFF_M * surface.face, owner[met] == GROUND)
    facing = np.clip(dot(surface.normal, light.sun), 0, 1) * (dot(surface.face, light.sun) > 0)
    sun = (lit * facing).astype(np.float32)[:, None] * light.sun_rgb
    reflected = surface.albedo * (sun + light.ambient(surface.normal) * open_sky.astype(np.float32)[:, None])
    shiny = np.flatnonzero(surface.gloss > 0.01)
    reflected[shiny] += _mirror_reflection(
        light, toward[met][shiny], surface.normal[shiny], surface.gloss[shiny], lit[shiny]
    )
    radiance[met] = light.apply_haze(reflected, (depth[met] * length[met]).astype(np.float32))
    return radiance


def _mirror_reflection(light: Light, toward: Real, normal: Real, gloss: Real, lit: Array) -> Real:
    """What lacquer and glass add: the sky by Schlick's approximation (Computer Graphics Forum 1994), and the sun's glint."""
    cosine = (toward * normal).sum(1)
    away = toward - 2 * cosine[:, None] * normal
    reflectance = _MIRROR + (1 - _MIRROR) * (1 - np.clip(np.abs(cosine), 0, 1)) ** 5
    sky = light.clear_sky_radiance(away)
    below = np.clip(-6 * away[:, 2:3], 0, 1)
    sky = sky + below * (0.25 * light.horizon_rgb - sky)
    glint = np.clip(dot(away, light.sun), 0, 1) ** 90 * lit
    return ((gloss * reflectance)[:, None] * sky + (gloss * glint * 0.7)[:, None] * light.sun_rgb).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _ShadingPoints:
    """Of N points: normals (N, 3), of the solid itself (face) and as light takes them; albedo (N, 3); gloss (N,)."""

    face: Real
    normal: Real
    albedo: Real
    gloss: Real


def _surfaces(
    lit_scene: LitScene, owner: NDArray[np.int32], points: Array, toward: Real, width: Real
) -> _ShadingPoints:
    n = len(points)
    face, normal, albedo = np.zeros((3, n, 3), np.float32)
    surface = _ShadingPoints(face, normal, albedo, np.zeros(n, np.float32))
    ground = np.flatnonzero(owner == GROUND)
    _fill_ground(surface, ground, lit_scene, points[ground], toward[ground], width[ground])
    solid = np.flatnonzero(owner >= 0)
    if len(solid):
        _fill_solids(surface, solid, lit_scene, owner[solid], points[solid], width[solid])
    return surface


def _fill_ground(
    surface: _ShadingPoints, rows: NDArray[np.int64], lit_scene: LitScene, points: Array, toward: Real, width: Real
) -> None:
    field = lit_scene.scene.ground
    x, y, cell = points[:, 0], points[:, 1], field.cell
    step = 0.5 * cell
    gx = (_height(lit_scene, x + step, y) - _height(lit_scene, x - step, y)) / cell
    gy = (_height(lit_scene, x, y + step) - _height(lit_scene, x, y - step)) / cell
    normal = np.stack((-gx, -gy, np.ones_like(gx)), -1)
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    steep = np.maximum(np.abs((normal * toward).sum(1)), 0.004)
    flat = np.hypot(toward[:, 0], toward[:, 1])
    reach = toward[:, :2] / np.maximum(flat, 1e-6)[:, None] * (width / steep * np.maximum(flat, steep))[:, None]
    surface.face[rows], surface.normal[rows] = normal, normal
    surface.albedo[rows] = ground_rgb(
        field, points[:, :2], reach.astype(np.float64), lit_scene.light.wear, lit_scene.light.seed
    )


def _height(lit_scene: LitScene, x: Array, y: Array) -> Array:
    """Return bilinear heights of the ground at points; the border value goes on outside."""
    field = lit_scene.scene.ground
    rows, columns = field.height.shape
    u = np.clip((x - field.x_min) / field.cell, 0, columns - 1.001)
    v = np.clip((y - field.y_min) / field.cell, 0, rows - 1.001)
    j, i = u.astype(np.int64), v.astype(np.int64)
    u, v, h = u - j, v - i, field.height
    return (h[i, j] * (1 - u) + h[i, j + 1] * u) * (1 - v) + (h[i + 1, j] * (1 - u) + h[i + 1, j + 1] * u) * v


def _fill_solids(
    surface: _ShadingPoints,
    rows: NDArray[np.int64],
    lit_scene: LitScene,
    owner: NDArray[np.int32],
    points: Array,
    width: Real,
) -> None:
    solids, materials = lit_scene.scene.solids, lit_scene.materials
    rotation = solids.rotation[owner]
    local = np.einsum("nji,nj->ni", rotation, points - solids.center[owner])
    half, kind = solids.half[owner], solids.kind[owner]
    axis = np.where(kind == BOX, (np.abs(local) - half).argmax(1), 0)
    side = np.sign(np.take_along_axis(local, axis[:, None], 1)[:, 0])
    face = np.zeros_like(local)
    np.put_along_axis(face, axis[:, None], side[:, None], 1)
    round_, crown = kind == CYLINDER, kind == ELLIPSOID
    face[round_] = local[round_] * (1, 1, 0)
    face[crown] = local[crown] / half[crown] ** 2
    normal = face.copy()
    lacquer = materials.material[owner] >= PAINTWORK
    normal[lacquer] += (
        0.7 * np.sign(local[lacquer]) * np.clip(1 - (half - np.abs(local))[lacquer] / _BEVEL_M, 0, 1) ** 2
    )
    face, normal = (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9) for v in (face, normal))
    # Leaves have all orientations: their light is softer than that of a smooth crown.
    normal[crown] = 0.5 * normal[crown] + (0, 0, 0.5)
    surface.face[rows] = np.einsum("nij,nj->ni", rotation, face)
    surface.normal[rows] = np.einsum("nij,nj->ni", rotation, normal)
    spots = SolidPoints(
        local.astype(np.float32), axis, side.astype(np.float32), half.astype(np.float32), width, materials.rgb[owner],
        materials.seed[owner], materials.anchor[owner], materials.size[owner], materials.axles[owner],
    )  # fmt: skip
    for material in np.unique(materials.material[owner]):
        here = np.flatnonzero(materials.material[owner] == material)
        surface.albedo[rows[here]], surface.gloss[rows[here]] = solid_rgb(
            int(material), spots[here], lit_scene.light.seed
        )
