# SPDX-License-Identifier: Apache-2.0
"""A store of observations and releases, and fusion tile by tile."""
