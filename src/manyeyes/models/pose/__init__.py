# SPDX-License-Identifier: Apache-2.0
"""Nets that match objects of two agents."""
