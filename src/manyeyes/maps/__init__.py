# SPDX-License-Identifier: Apache-2.0
"""What persists after the drive."""
