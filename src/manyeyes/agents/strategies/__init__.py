# SPDX-License-Identifier: Apache-2.0
"""Fusion strategies: how an agent composes messages and fuses received ones. One file a strategy."""
