# SPDX-License-Identifier: Apache-2.0
"""Layout of signed packets and of certificates; keys are held by ``manyeyes.runtime``."""
