# SPDX-License-Identifier: Apache-2.0
"""Networks (``comms.network.interface.Network``): in one process, UDP multicast, zenoh."""
