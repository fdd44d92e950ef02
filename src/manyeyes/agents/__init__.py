# SPDX-License-Identifier: Apache-2.0
"""One agent's whole step, and many agents on one recording."""
