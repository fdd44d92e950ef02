# SPDX-License-Identifier: Apache-2.0
"""Intervals, paired differences and comparisons with margins."""
