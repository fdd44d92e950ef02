# SPDX-License-Identifier: Apache-2.0
"""Misbehaviour detectors, one method a file."""
