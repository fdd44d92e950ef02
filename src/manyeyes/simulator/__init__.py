# SPDX-License-Identifier: Apache-2.0
"""Simulation of towns, traffic, sensors and map fleets, reproducible from a seed."""
