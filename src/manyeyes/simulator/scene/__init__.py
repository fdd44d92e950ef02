# SPDX-License-Identifier: Apache-2.0
"""Roads, traffic and what stands beside them."""
