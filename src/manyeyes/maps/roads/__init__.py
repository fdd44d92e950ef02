# SPDX-License-Identifier: Apache-2.0
"""Road networks, and the true map that follows from them."""
