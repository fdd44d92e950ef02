# SPDX-License-Identifier: Apache-2.0
"""Ed25519 keys (RFC 8032) and certificates on disk: keys as PKCS#8, readable by their owner only; certificates as 126 bytes."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manyeyes._io import atomic_replace, atomic_write, read_file
from manyeyes.comms.signatures.certificate import (
    CERTIFICATE_BYTES,
    Area,
    Certificate,
    Right,
    make_identifier,
)
from manyeyes.datatypes import ConfigError, ManyeyesError, WireError
from manyeyes.datatypes.extras import import_extra

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

KEY_SUFFIX, CERTIFICATE_SUFFIX = ".key", ".cert"
_MAX_KEY_BYTES = 16_384


class KeyFileError(ManyeyesError):
    """A key or certificate file that is missing, damaged, readable by others, or protected by another pass phrase."""


def _ed25519() -> Any:
    return import_extra("cryptography.hazmat.primitives.asymmetric.ed25519", "live", "Signing packets")


def _serialization() -> Any:
    return import_extra("cryptography.hazmat.primitives.serialization", "live", "Reading keys")


def generate_key() -> Ed25519PrivateKey:
    """Return a new private key from the random source of the operating system."""
    return _ed25519().Ed25519PrivateKey.generate()


def read_public_key(data: bytes) -> Ed25519PublicKey:
    """Return the public key of its 32 bytes."""
    return _ed25519().Ed25519PublicKey.from_public_bytes(data)


def public_bytes(key: Ed25519PrivateKey) -> bytes:
    """Return the 32 bytes of the public key of a private key."""
    return key.public_key().public_bytes_raw()


def is_signature(public_key: Ed25519PublicKey, signature: bytes, content: bytes) -> bool:
    """Return whether a signature of content is valid."""
    invalid = import_extra("cryptography.exceptions", "live", "Verifying packets").InvalidSignature
    try:
        public_key.verify(signature, content)
    except invalid:
        return False
    return True


def save_key(path: Path, key: Ed25519PrivateKey, passphrase: bytes | None = None) -> None:
    """Write a private key as PKCS#8 (PEM) with mode 0600, whole or not at all; a pass phrase encrypts it."""
    formats = _serialization()
    protection = formats.BestAvailableEncryption(passphrase) if passphrase else formats.NoEncryption()
    data: bytes = key.private_bytes(formats.Encoding.PEM, formats.PrivateFormat.PKCS8, protection)
    with atomic_replace(path) as temporary:
        temporary.unlink(missing_ok=True)
        # Created with its mode: at no time can others read it.
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "wb") as file:
            file.write(data)


def load_key(path: Path, passphrase: bytes | None = None) -> Ed25519PrivateKey:
    """Read a private key.

    Raises:
        KeyFileError: others may read the file, it is no Ed25519 key, or the pass phrase is wrong.
    """
    data = read_file(path, _MAX_KEY_BYTES)
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o077:
        raise KeyFileError(
            f"{path}: others may read this private key (mode {mode:04o}, expected 0600); run chmod 600, or make a new key."
        )
    try:
        key = _serialization().load_pem_private_key(data, passphrase)
    except (ValueError, TypeError) as error:
        raise KeyFileError(f"{path}: no private key, or another pass phrase ({error}).") from None
    if not isinstance(key, _ed25519().Ed25519PrivateKey):
        raise KeyFileError(f"{path}: not an Ed25519 key; manyeyes keys makes them.")
    return key


def save_certificate(path: Path, certificate: Certificate) -> None:
    """Write a certificate, whole or not at all."""
    atomic_write(path, certificate.pack())


def load_certificate(path: Path) -> Certificate:
    """Read a certificate; its signature is not verified.

    Raises:
        KeyFileError: the file holds no certificate.
    """
    try:
        return Certificate.read(read_file(path, CERTIFICATE_BYTES + 1))
    except (WireError, OSError) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise KeyFileError(f"{path}: no certificate ({error})") from error


@dataclass(frozen=True)
class Issuer:
    """Who signs certificates: an anchor, or the holder of a certificate with the right ``issuer``."""

    key: Ed25519PrivateKey
    identifier: bytes

    @classmethod
    def of_anchor(cls, key: Ed25519PrivateKey) -> Issuer:
        """Return the issuer that an anchor's key is: its identifier is that of the bare public key."""
        return cls(key, make_identifier(public_bytes(key)))

    def issue(self, public_key: bytes, rights: Iterable[Right], agent_id: int, valid: Validity) -> Certificate:
        """Return a signed certificate of a public key."""
        unsigned = Certificate(
            frozenset(rights),
            agent_id,
            valid.not_before_s,
            valid.lifetime_min,
            valid.area,
            public_key,
            self.identifier,
        )
        return replace(unsigned, signature=self.key.sign(unsigned.signed_content))


@dataclass(frozen=True)
class Validity:
    """When and where a certificate is valid. area: None is anywhere."""

    not_before_s: int
    lifetime_min: int = 60
    area: Area | None = None


@dataclass(frozen=True)
class Identity:
    """A private key and the certificate of its public key."""

    key: Ed25519PrivateKey
    certificate: Certificate

    def __post_init__(self) -> None:
        if public_bytes(self.key) != self.certificate.public_key:
            raise ConfigError("Identity: the certificate is of another key; use the .cert file beside the .key file.")

    @property
    def agent_id(self) -> int:
        """The pseudonym, from the certificate."""
        return self.certificate.agent_id

    def save(self, stem: Path, passphrase: bytes | None = None) -> None:
        """Write ``STEM.key`` and ``STEM.cert``."""
        save_key(stem.with_name(stem.name + KEY_SUFFIX), self.key, passphrase)
        save_certificate(stem.with_name(stem.name + CERTIFICATE_SUFFIX), self.certificate)

    @classmethod
    def load(cls, key_file: Path, passphrase: bytes | None = None) -> Identity:
        """Read ``NAME.key`` and the ``NAME.cert`` beside it."""
        certificate = load_certificate(key_file.with_suffix(CERTIFICATE_SUFFIX))
        return cls(load_key(key_file, passphrase), certificate)
