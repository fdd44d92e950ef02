# SPDX-License-Identifier: Apache-2.0
"""Intermediate fusion of the tokens of several agents; one published method per file."""
