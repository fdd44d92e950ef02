# SPDX-License-Identifier: Apache-2.0
"""Pictures, tables and reports of what agents saw."""
