# SPDX-License-Identifier: Apache-2.0
"""The detector: points to tokens to boxes."""
