# SPDX-License-Identifier: Apache-2.0
"""Agents on a network: keys and certificates, signed packets, transports, clocks, and the loop of one agent."""
