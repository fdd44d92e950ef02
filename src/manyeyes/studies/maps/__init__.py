# SPDX-License-Identifier: Apache-2.0
"""Studies of map fusion on simulated fleets, and of the map model, in the form of the CrowdMap paper's tables."""
