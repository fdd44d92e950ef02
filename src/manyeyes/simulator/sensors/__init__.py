# SPDX-License-Identifier: Apache-2.0
"""Simulated LiDAR and cameras of a scene."""
