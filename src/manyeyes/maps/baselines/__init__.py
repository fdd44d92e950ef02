# SPDX-License-Identifier: Apache-2.0
"""Other ways to make one map of many observations, one file each: ``fuse(observations, config, frame) -> VectorMap``."""
