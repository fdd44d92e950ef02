# SPDX-License-Identifier: Apache-2.0
"""The share and perceive steps of one agent, and replays of recordings with many agents."""
