# SPDX-License-Identifier: Apache-2.0
"""Neural networks: from point clouds and images to tokens, and from the tokens of several agents to boxes and map
elements.
"""
