# SPDX-License-Identifier: Apache-2.0
"""Between a net that describes objects and the messages that carry its words (FeaKM section 4.2.1).

Places, headings and sizes go as a message's objects, 13 bytes each; descriptors beside them, a byte a number (comms/wire.py).
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
    """The agent's own boxes, or those of them that are given, as far as the net takes them for keypoints: best first."""
    keypoint_config = net.config.keypoints
    if not isinstance(keypoint_config, BoxKeypointConfig) or keypoint_config.descriptor_dim != DESCRIPTOR_DIM:
        raise ConfigError(
            f"A message carries objects with {DESCRIPTOR_DIM} numbers each; this net has {keypoint_config.descriptor_dim} "
            f"of {type(keypoint_config).__name__}. Nets of 'manyeyes train --preset feakm-small' can be sent; --study feakm takes any."
        )
    net.check_views(cache.detector.fingerprint)
    output = cache.process(frame)
    with torch.inference_mode():
        return net.describe([DetectorView.of(output.shared_tokens, output.boxes if boxes is None else boxes)])[0]


def attach_descriptors(net: FeakmNet, cache: PerceptionCache, frame: AgentFrame, message: Message) -> Message:
    """The message of a frame with the descriptor of each of its objects, zeros for those that the net leaves out; a message
    without objects gets those that the net describes.
    """
    points = extract_own_keypoints(net, cache, frame, message.objects)
    objects = points.boxes if message.objects is None else message.objects
    descriptors = torch.zeros(len(objects), DESCRIPTOR_DIM)
    # Boxes are ordered by score, so that the net's are the first.
    descriptors[: len(points)] = points.descriptor
    return replace(message, objects=objects, descriptors=descriptors)


def extract_message_keypoints(message: Message) -> Keypoints | None:
    """What a message describes; None where its sender describes nothing."""
    if message.objects is None or message.descriptors is None:
        return None
    points = Keypoints(message.objects, message.descriptors)
    return points[points.descriptor.any(1)]
