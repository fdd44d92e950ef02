# SPDX-License-Identifier: Apache-2.0
"""Keypoint descriptors of objects in messages (FeaKM section 4.2.1).

Positions, headings and sizes are sent as objects of a message, 14 bytes each; descriptors take one byte a channel (comms/wire.py).
"""

from __future__ import annotations

from dataclasses import replace

import torch

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.datatypes import AgentFrame, Boxes, ConfigError, Message
from manyeyes.datatypes.keypoints import Keypoints
from manyeyes.datatypes.message import DESCRIPTOR_DIM
from manyeyes.models.pose.box_descriptors import BoxKeypointConfig
from manyeyes.models.pose.feakm import FeakmNet
from manyeyes.models.pose.keypoint_net import DetectorView


def extract_own_keypoints(
    net: FeakmNet, cache: PerceptionCache, frame: AgentFrame, boxes: Boxes | None = None
) -> Keypoints:
    """Return keypoints among the agent's own boxes, or among the given ones, by falling score."""
    keypoint_config = net.config.keypoints
    if not isinstance(keypoint_config, BoxKeypointConfig) or keypoint_config.descriptor_dim != DESCRIPTOR_DIM:
        raise ConfigError(
            f"A message carries objects with {DESCRIPTOR_DIM} numbers each; this net has {keypoint_config.descriptor_dim} "
            f"of {type(keypoint_config).__name__}. Use a net of 'manyeyes train --preset feakm-small'; "
            "study feakm takes any net."
        )
    net.check_views(cache.detector.fingerprint)
    output = cache.process_tokens(frame)
    with torch.inference_mode():
        return net.describe([DetectorView.of(output.shared_tokens, output.boxes if boxes is None else boxes)])[0]


def attach_descriptors(net: FeakmNet, cache: PerceptionCache, frame: AgentFrame, message: Message) -> Message:
    """Return the message of a frame with a descriptor for each of its objects, zeros for those that are no keypoints.

    A message without objects gets the boxes of the keypoints.
    """
    points = extract_own_keypoints(net, cache, frame, message.objects)
    objects = points.boxes if message.objects is None else message.objects
    descriptors = torch.zeros(len(objects), DESCRIPTOR_DIM)
    # Boxes are ordered by score, so that the net's are the first.
    descriptors[: len(points)] = points.descriptor
    return replace(message, objects=objects, descriptors=descriptors)


def extract_message_keypoints(message: Message) -> Keypoints | None:
    """Return keypoints of a message; None without descriptors."""
    if message.objects is None or message.descriptors is None:
        return None
    points = Keypoints(message.objects, message.descriptors)
    return points[points.descriptor.any(1)]
