# SPDX-License-Identifier: Apache-2.0
"""Networks (``comms.network.Network``): in one process, UDP multicast, zenoh."""
