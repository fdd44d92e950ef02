# SPDX-License-Identifier: Apache-2.0
"""Attacks of malicious agents on cooperative detection, and the study that measures them and defences against them."""
