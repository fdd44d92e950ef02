# SPDX-License-Identifier: Apache-2.0
"""Who is where: relative poses of agents from what they see, and whether a claimed pose can be believed."""
