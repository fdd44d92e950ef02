# SPDX-License-Identifier: Apache-2.0
"""Folders of keys that ``manyeyes keys`` makes: anchors, issuers, and agents with their certificates."""

from __future__ import annotations

import secrets
import time
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

from manyeyes.comms.signatures.certificate import RIGHTS, SENDER_RIGHTS, Certificate, Right
from manyeyes.datatypes import ConfigError
from manyeyes.runtime.keys import (
    CERTIFICATE_SUFFIX,
    Identity,
    Issuer,
    KeyFileError,
    Validity,
    generate_key,
    is_signature,
    load_certificate,
    load_key,
    public_bytes,
    read_public_key,
    save_key,
)
from manyeyes.runtime.trust_file import Anchor, NamedCertificate, Revocations, Trust

TRUST_FILE, ANCHOR_KEY = "trust.toml", "anchor.key"
CLOCK_TOLERANCE_S = 60
DAY_MIN = 1_440


@dataclass(frozen=True)
class AnchorFiles:
    """The private key of an anchor, and the trust file that admits it."""

    key: Path
    trust: Path


def make_anchor(folder: Path, name: str, days: int, passphrase: bytes | None = None) -> AnchorFiles:
    """Make an anchor that may grant all rights, and a trust file.

    Raises:
        ConfigError: the folder has them already.
    """
    files = AnchorFiles(folder / ANCHOR_KEY, folder / TRUST_FILE)
    _refuse_existing(files.key, files.trust)
    key = generate_key()
    anchor = Anchor(name, public_bytes(key), frozenset(RIGHTS), time.time() + 86_400.0 * days)
    Trust.parse(Trust((anchor,)).to_toml())
    save_key(files.key, key, passphrase)
    Trust((anchor,), revoked=Revocations(updated_s=time.time())).save(files.trust)
    return files


def load_issuer(key_file: Path, passphrase: bytes | None = None) -> Issuer:
    """Read the key of an anchor, or that of an issuer with the certificate beside it."""
    key, beside = load_key(key_file, passphrase), key_file.with_suffix(CERTIFICATE_SUFFIX)
    if not beside.exists():
        return Issuer.of_anchor(key)
    certificate = Identity(key, load_certificate(beside)).certificate
    if "issuer" not in certificate.rights:
        raise KeyFileError(f"{beside}: this certificate has no right to issue others; use the key of an issuer.")
    return Issuer(key, certificate.identifier)


def make_issuer(stem: Path, anchor_key: Path, trust_file: Path, days: int, passphrase: bytes | None = None) -> Identity:
    """Make an issuer that an anchor signs, and add it to a trust file."""
    _refuse_existing(*_files_of(stem))
    valid = Validity(round(time.time()) - CLOCK_TOLERANCE_S, days * DAY_MIN)
    key, trust = generate_key(), Trust.load(trust_file)
    certificate = load_issuer(anchor_key, passphrase).issue(public_bytes(key), RIGHTS, 0, valid)
    issuer = Identity(key, certificate)
    extended = replace(trust, issuers=(*trust.issuers, NamedCertificate(stem.name, certificate)))
    if certificate.identifier not in extended.grantors():
        raise ConfigError(f"{anchor_key}: {trust_file} has no anchor with this key; use the anchor beside it.")
    issuer.save(stem, passphrase)
    extended.save(trust_file)
    return issuer


def make_agent(
    stem: Path,
    issuer: Issuer,
    agent_id: int,
    rights: Collection[Right] = SENDER_RIGHTS,
    lifetime_min: int = 60,
    passphrase: bytes | None = None,
) -> Identity:
    """Make a key of an agent, and its certificate from now on."""
    _refuse_existing(*_files_of(stem))
    key, valid = generate_key(), Validity(round(time.time()) - CLOCK_TOLERANCE_S, lifetime_min)
    agent = Identity(key, issuer.issue(public_bytes(key), rights, agent_id, valid))
    agent.save(stem, passphrase)
    return agent


def make_pool(
    folder: Path, issuer: Issuer, count: int, lifetime_min: int = 60, passphrase: bytes | None = None
) -> tuple[Identity, ...]:
    """Make pseudonyms of one agent, with random agent ids."""
    ids = {secrets.randbelow(2**31 - 1) + 1 for _ in range(count)}
    while len(ids) < count:
        ids.add(secrets.randbelow(2**31 - 1) + 1)
    return tuple(
        make_agent(folder / f"{number:03d}", issuer, agent_id, lifetime_min=lifetime_min, passphrase=passphrase)
        for number, agent_id in enumerate(ids)
    )


def make_demo_federation(folder: Path, agent_ids: Collection[int], lifetime_min: int = 60) -> Path:
    """Make an anchor, an issuer, and an agent for each id, with all rights of senders; return the trust file."""
    anchor = make_anchor(folder, "demo", 30)
    issuer = make_issuer(folder / "issuer", anchor.key, anchor.trust, 7)
    rights = frozenset[Right]((*SENDER_RIGHTS, "infrastructure"))
    for agent_id in agent_ids:
        stem = folder / f"agent-{agent_id}"
        make_agent(stem, Issuer(issuer.key, issuer.certificate.identifier), agent_id, rights, lifetime_min)
    return anchor.trust


def revoke(trust_file: Path, certificate: Certificate) -> Trust:
    """Add a certificate to the revocations of a trust file, and return it."""
    trust = Trust.load(trust_file)
    identifier, revoked = certificate.identifier, replace(trust.revoked, updated_s=time.time())
    if "issuer" in certificate.rights:
        revoked = replace(revoked, issuers=revoked.issuers | {identifier})
    else:
        revoked = replace(revoked, signers=revoked.signers | {identifier})
    changed = replace(trust, revoked=revoked)
    changed.save(trust_file)
    return changed


def find_fault(certificate: Certificate, trust: Trust, now_s: float) -> str | None:
    """Describe why a trust file does not admit a certificate at a time; None where it does."""
    if certificate.identifier in trust.revoked.signers | trust.revoked.issuers:
        return "it is revoked"
    if certificate.issuer in trust.revoked.issuers:
        return "its issuer is revoked"
    issuer = trust.grantors().get(certificate.issuer)
    if issuer is None:
        return f"its issuer {certificate.issuer.hex()} is not in the trust file"
    if not is_signature(read_public_key(issuer.public_key), certificate.signature, certificate.signed_content):
        return "its signature is wrong"
    if not issuer.covers(certificate):
        return "its issuer may not grant these rights, or this area"
    if not (certificate.is_valid_at(now_s) and issuer.from_s <= now_s <= issuer.until_s):
        return "it, or its issuer, is not valid now"
    return None


def _files_of(stem: Path) -> tuple[Path, Path]:
    return stem.with_name(f"{stem.name}.key"), stem.with_name(f"{stem.name}{CERTIFICATE_SUFFIX}")


def _refuse_existing(*paths: Path) -> None:
    for path in paths:
        if path.exists():
            raise ConfigError(f"{path} exists; keys are not overwritten: choose another --out, or remove it.")
