# SPDX-License-Identifier: Apache-2.0
"""Observations and maps of elements, and their files."""
