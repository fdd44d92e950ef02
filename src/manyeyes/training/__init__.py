# SPDX-License-Identifier: Apache-2.0
"""Training of detectors, map models and pose matchers."""
