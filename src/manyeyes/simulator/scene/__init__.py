# SPDX-License-Identifier: Apache-2.0
"""Roads, traffic and roadside objects of a scene."""
