# SPDX-License-Identifier: Apache-2.0
"""Misbehaviour detection: evidence on what senders claim, trust in senders, and their weights in fusion."""
