# SPDX-License-Identifier: Apache-2.0
"""The map model: sensors to map elements."""
