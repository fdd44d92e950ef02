# SPDX-License-Identifier: Apache-2.0
"""Interface of networks, tiles that scope them, and bounded buffers."""
