# SPDX-License-Identifier: Apache-2.0
"""Relative pose estimation between agents, from landmarks or clouds, with tests of the prior pose."""
