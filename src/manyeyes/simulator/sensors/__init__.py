# SPDX-License-Identifier: Apache-2.0
"""LiDAR and cameras in a scene."""
