# SPDX-License-Identifier: Apache-2.0
"""Options of commands that run agents on a network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from manyeyes._bounds import ByteCount, DurationS, InputPath, PortNumber

if TYPE_CHECKING:
    from manyeyes.agents.agent import Agent
    from manyeyes.comms.network.interface import Network
    from manyeyes.runtime.recorder import RunConfig
    from manyeyes.runtime.security import Security


@dataclass(frozen=True)
class NetworkOptions:
    """The network between agents; by default, nothing leaves this machine."""

    transport: Literal["zenoh", "udp"] = "zenoh"
    """zenoh: peers that find each other by seeds and gossip. udp: multicast, one datagram a packet."""
    net: str = "default"
    """Name of the network; agents receive those of their own only."""
    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    """zenoh: endpoints on which others connect, such as tcp/0.0.0.0:7447; port 0 is any."""
    connect: tuple[str, ...] = ()
    """zenoh: endpoints of other agents; one is enough, since it reports the others."""
    scouting: bool = False
    """zenoh: find other agents by multicast, too."""
    zenoh_config: InputPath | None = None
    """zenoh: a configuration file (JSON5) that is read first, for TLS and access control."""
    interface: str = "127.0.0.1"
    """udp: address of the interface; on any other but the loopback, datagrams reach the local network."""
    port: PortNumber = 17_448
    """udp: the port of all agents of a network."""

    def open(self, agent_id: int, clock: Callable[[], int]) -> Network:
        """Join the network as an agent."""
        if self.transport == "udp":
            from manyeyes.runtime.transports.udp import UdpConfig, UdpNetwork

            ttl = 0 if self.interface.startswith("127.") else 1
            return UdpNetwork(UdpConfig(self.net, self.interface, self.port, ttl), clock)
        from manyeyes.runtime.transports.zenoh import ZenohConfig, ZenohNetwork

        file = None if self.zenoh_config is None else str(self.zenoh_config)
        return ZenohNetwork(ZenohConfig(self.net, self.listen, self.connect, self.scouting, file), agent_id, clock)


@dataclass(frozen=True)
class SecurityOptions:
    """Keys, trust file and mode of signatures."""

    security: Literal["off", "warn", "require"] = "off"
    """off: nothing is signed. warn: unsigned packets are accepted from a few senders. require: they are refused."""
    trust: InputPath | None = None
    """The trust file; it is read again when it changes."""
    key: InputPath | None = None
    """The private key, with its certificate beside it, or a folder with a pool of pseudonyms."""
    passphrase_file: InputPath | None = None
    """A file with the pass phrase of the key."""

    def load(self, seed: int) -> Security:
        """Read the keys. seed: of the silent periods between pseudonyms."""
        from manyeyes.cli.keys.passphrase import read_passphrase
        from manyeyes.runtime.pseudonyms import PseudonymPool
        from manyeyes.runtime.security import Security

        pool = None
        if self.key is not None:
            pool = PseudonymPool.load(self.key, read_passphrase(self.passphrase_file), seed)
        return Security(self.security, pool, self.trust)


@dataclass(frozen=True)
class MethodOptions:
    """What an agent sends and fuses."""

    weights: str = "costr-small"
    """Shipped weights or a registered detector by name, or a .safetensors file of 'manyeyes train'."""
    method: str = "intermediate"
    """A strategy by name, one of your own too."""
    budget_bytes: ByteCount = 1 << 17
    """The most that a message of tokens may weigh, with its signatures."""
    sight: bool = False
    """Send how far the space around the LiDAR is free, 248 bytes a message, for the misbehaviour detectors of others."""
    pose_correction: str | None = None
    """Correct the poses of senders before fusion, by this corrector."""
    map_weights: str | None = None
    """Send local maps of this map model, too, such as map-small-lidar; 'live map' fuses them."""
    map_period_s: DurationS = 1.0
    """Time from one local map to the next; predicting one takes longer than a frame."""
    misbehaviour: str | None = None
    """Weigh senders by trust: ray-evidence, a baseline (none, oracle, robosac, cp-guard), or a name of your own."""

    def describe(self, fingerprint: bytes, security: str) -> RunConfig:
        """Return the settings as a recording holds them."""
        import torch

        from manyeyes.runtime.clock import TAI_UTC_NS
        from manyeyes.runtime.recorder import RunConfig
        from manyeyes.studies.provenance import installed_versions

        return RunConfig(
            weights=_absolute(self.weights),
            fingerprint=fingerprint.hex(),
            strategy=self.method,
            budget_bytes=self.budget_bytes,
            pose_correction=self.pose_correction,
            security=security,
            versions=installed_versions(),
            num_threads=torch.get_num_threads(),
            misbehaviour=self.misbehaviour,
            send_sight=self.sight,
            map_weights=None if self.map_weights is None else _absolute(self.map_weights),
            map_period_s=self.map_period_s,
            utc_offset_ns=-TAI_UTC_NS,
        )


def _absolute(weights: str) -> str:
    return str(Path(weights).resolve()) if Path(weights).is_file() else weights


def make_agent(config: RunConfig) -> Agent:
    """Make the agent of the settings of a run.

    Raises:
        CheckpointError: the weights of this name are others than those of the run.
    """
    from manyeyes.agents.agent import Agent
    from manyeyes.agents.map_perception import MapModelPredictor
    from manyeyes.agents.periodic_map import PeriodicMapPredictor
    from manyeyes.agents.pose_correction import PoseCorrection
    from manyeyes.agents.strategies.registry import get_strategy
    from manyeyes.agents.trust.registry import get_misbehaviour_detector
    from manyeyes.datatypes import CheckpointError
    from manyeyes.models import pretrained

    detector = pretrained.load(config.weights)
    if detector.fingerprint.hex() != config.fingerprint:
        raise CheckpointError(
            f"Weights {config.weights} are {detector.fingerprint.hex()}; the run had {config.fingerprint}: use the same."
        )
    map_predictor = None
    if config.map_weights is not None:
        map_model = pretrained.load_map_model(config.map_weights)
        map_predictor = PeriodicMapPredictor(MapModelPredictor(map_model), round(config.map_period_s * 1e9))
    correction = None if config.pose_correction is None else PoseCorrection(config.pose_correction)
    return Agent(
        detector,
        get_strategy(config.strategy),
        budget_bytes=config.budget_bytes,
        pose_correction=correction,
        map_predictor=map_predictor,
        misbehaviour=None if config.misbehaviour is None else get_misbehaviour_detector(config.misbehaviour),
        send_sight=config.send_sight,
    )
