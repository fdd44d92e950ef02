# SPDX-License-Identifier: Apache-2.0
"""Studies of detection: a file for each table or figure."""
