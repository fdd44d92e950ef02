# SPDX-License-Identifier: Apache-2.0
"""What has weights: from clouds to tokens, from tokens of many agents to boxes."""
