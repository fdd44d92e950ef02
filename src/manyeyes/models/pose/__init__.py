# SPDX-License-Identifier: Apache-2.0
"""Networks that match the objects of two agents."""
