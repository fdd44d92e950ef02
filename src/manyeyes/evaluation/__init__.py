# SPDX-License-Identifier: Apache-2.0
"""Numbers about a run."""
