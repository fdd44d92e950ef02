# SPDX-License-Identifier: Apache-2.0
"""Families of attacks, one file each; ``studies.attacks.catalog`` names them with their settings."""
