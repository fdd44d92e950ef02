# SPDX-License-Identifier: Apache-2.0
"""Reproduce tables and figures; and what commands share: recordings, reports and maps on disk."""
