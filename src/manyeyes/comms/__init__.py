# SPDX-License-Identifier: Apache-2.0
"""Bytes between agents: what to send, how it is written, what the air does to it, what is taken in."""
