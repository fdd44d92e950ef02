# SPDX-License-Identifier: Apache-2.0
"""Studies of pose correction: a file for each table or figure."""
