# SPDX-License-Identifier: Apache-2.0
"""Files that several data sets have: point clouds, pictures; and a cache of what was slow to parse."""
