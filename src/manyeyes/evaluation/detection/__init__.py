# SPDX-License-Identifier: Apache-2.0
"""Metrics of detected boxes and of messages."""
