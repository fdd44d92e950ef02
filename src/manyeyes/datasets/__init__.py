# SPDX-License-Identifier: Apache-2.0
"""Recordings on disk: one reader a layout; `Snapshot` comes out, and nothing else."""
