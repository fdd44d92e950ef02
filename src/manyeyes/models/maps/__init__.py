# SPDX-License-Identifier: Apache-2.0
"""The map model: from sensor data to map elements."""
