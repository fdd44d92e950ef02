# SPDX-License-Identifier: Apache-2.0
"""Fusion of several agents' tokens; one published idea a file."""
