# SPDX-License-Identifier: Apache-2.0
"""Metrics of attacks and of defences against them: which claims can be checked, who is accused, and after how long."""
