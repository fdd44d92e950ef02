# SPDX-License-Identifier: Apache-2.0
"""Map files of others."""
