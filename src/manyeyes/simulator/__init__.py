# SPDX-License-Identifier: Apache-2.0
"""Scenes from a seed."""
