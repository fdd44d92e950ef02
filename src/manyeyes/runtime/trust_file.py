# SPDX-License-Identifier: Apache-2.0
"""Trust file (TOML): the anchors and issuers whose certificates a receiver accepts, and what is revoked.

```toml
[[anchor]]
name = "demo"
key = "<64 hexadecimal digits>"
rights = ["objects", "tokens", "points", "map", "infrastructure", "issuer"]
until = 2026-12-31T00:00:00Z
# area = [0, -2, 4, 4]        first square i, j of comms.network.tiles, and their numbers; without it: anywhere

[[issuer]]
name = "issuer"
certificate = "<252 hexadecimal digits>"

[revoked]
signers = []                  # identifiers, 16 hexadecimal digits
issuers = []
updated = 2026-01-01T00:00:00Z
next = 2026-02-01T00:00:00Z   # when the next list is due
```
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from manyeyes._io import atomic_write_text, read_file
from manyeyes.comms.signatures.certificate import (
    IDENTIFIER_BYTES,
    KEY_BYTES,
    RIGHTS,
    Area,
    Certificate,
    Right,
    make_identifier,
)
from manyeyes.datatypes import ManyeyesError, WireError
from manyeyes.datatypes.errors import shorten
from manyeyes.runtime.keys import is_signature, read_public_key

_MAX_BYTES = 1 << 20
_NAME_CHARACTERS = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-_. ")


class TrustFileError(ManyeyesError):
    """A trust file that cannot be used; the text names file and field."""


@dataclass(frozen=True)
class Anchor:
    """A key that certificates are traced to. rights: those that it may grant; area: None is anywhere; until_s: since 1970."""

    name: str
    public_key: bytes
    rights: frozenset[Right]
    until_s: float
    area: Area | None = None

    @property
    def identifier(self) -> bytes:
        """Identifier by which certificates name it."""
        return make_identifier(self.public_key)


@dataclass(frozen=True)
class NamedCertificate:
    """The certificate of an issuer."""

    name: str
    certificate: Certificate


@dataclass(frozen=True)
class Revocations:
    """Identifiers of certificates that are revoked: of senders, and of issuers. updated_s, next_s: seconds since 1970."""

    signers: frozenset[bytes] = frozenset()
    issuers: frozenset[bytes] = frozenset()
    updated_s: float = 0.0
    next_s: float | None = None


@dataclass(frozen=True)
class Grantor:
    """An anchor or issuer, as the check of a certificate needs it."""

    public_key: bytes
    rights: frozenset[Right]
    area: Area | None
    from_s: float
    until_s: float

    def covers(self, certificate: Certificate) -> bool:
        """Return whether it may grant the rights and the area of a certificate."""
        inside = self.area is None or (certificate.area is not None and certificate.area.is_within(self.area))
        return certificate.rights <= self.rights and inside


@dataclass(frozen=True)
class Trust:
    """Content of a trust file. Issuers come from it alone, never from received packets."""

    anchors: tuple[Anchor, ...] = ()
    issuers: tuple[NamedCertificate, ...] = ()
    revoked: Revocations = field(default_factory=Revocations)

    def grantors(self) -> Mapping[bytes, Grantor]:
        """Return anchors and issuers by identifier; issuers that no anchor has signed, and revoked ones, are left out."""
        found = {a.identifier: Grantor(a.public_key, a.rights, a.area, 0.0, a.until_s) for a in self.anchors}
        anchors = dict(found)
        for issuer in self.issuers:
            certificate = issuer.certificate
            anchor = anchors.get(certificate.issuer)
            is_issued = (
                anchor is not None
                and "issuer" in certificate.rights
                and anchor.covers(certificate)
                and is_signature(read_public_key(anchor.public_key), certificate.signature, certificate.signed_content)
            )
            if is_issued and anchor is not None:
                until_s = min(float(certificate.not_after_s), anchor.until_s)
                found[certificate.identifier] = Grantor(
                    certificate.public_key,
                    certificate.rights - {"issuer"},
                    certificate.area,
                    float(certificate.not_before_s),
                    until_s,
                )
        return {identifier: one for identifier, one in found.items() if identifier not in self.revoked.issuers}

    def to_toml(self) -> str:
        """Return the text of a trust file."""
        lines: list[str] = []
        for anchor in self.anchors:
            rights = ", ".join(f'"{right}"' for right in RIGHTS if right in anchor.rights)
            lines += ["[[anchor]]", f'name = "{anchor.name}"', f'key = "{anchor.public_key.hex()}"']
            lines += [f"rights = [{rights}]", f"until = {_format_time(anchor.until_s)}"]
            if anchor.area is not None:
                area = anchor.area
                lines.append(f"area = [{area.i}, {area.j}, {area.num_i}, {area.num_j}]")
            lines.append("")
        for issuer in self.issuers:
            lines += ["[[issuer]]", f'name = "{issuer.name}"', f'certificate = "{issuer.certificate.pack().hex()}"', ""]
        lines += ["[revoked]", f"signers = {_format_list(self.revoked.signers)}"]
        lines += [
            f"issuers = {_format_list(self.revoked.issuers)}",
            f"updated = {_format_time(self.revoked.updated_s)}",
        ]
        if self.revoked.next_s is not None:
            lines.append(f"next = {_format_time(self.revoked.next_s)}")
        return "\n".join(lines) + "\n"

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        atomic_write_text(path, self.to_toml())

    @classmethod
    def load(cls, path: Path) -> Trust:
        """Read a trust file.

        Raises:
            TrustFileError: the text names the field that cannot be used.
        """
        try:
            return cls.parse(read_file(path, _MAX_BYTES).decode())
        except (UnicodeDecodeError, TrustFileError) as error:
            raise TrustFileError(f"{path}: {error}") from None

    @classmethod
    def parse(cls, text: str) -> Trust:
        """Return the content of the text of a trust file."""
        try:
            content = tomllib.loads(text)
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raise TrustFileError(f"not a TOML file ({error}).") from None
        _check_names("the file", content, {"anchor", "issuer", "revoked"})
        anchors = tuple(_read_anchor(f"anchor {k}", row) for k, row in enumerate(_tables(content, "anchor"), 1))
        issuers = tuple(_read_issuer(f"issuer {k}", row) for k, row in enumerate(_tables(content, "issuer"), 1))
        return cls(anchors, issuers, _read_revoked(content.get("revoked", {})))


def _tables(content: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    rows = content.get(name, [])
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise TrustFileError(f"{name} needs tables [[{name}]]; got {shorten(rows)}.")
    return rows


def _read_anchor(place: str, row: Mapping[str, Any]) -> Anchor:
    _check_names(place, row, {"name", "key", "rights", "until", "area"})
    rights = row.get("rights")
    if not isinstance(rights, list) or not rights or set(map(str, rights)) - set(RIGHTS):
        raise TrustFileError(f"{place}: rights are some of {', '.join(RIGHTS)}; got {shorten(rights)}.")
    key = _read_hex(f"{place}: key", row.get("key"), KEY_BYTES)
    area = row.get("area")
    return Anchor(
        _read_name(place, row),
        key,
        frozenset(rights),
        _read_time(f"{place}: until", row.get("until")),
        None if area is None else _read_area(place, area),
    )


def _read_area(place: str, value: Any) -> Area:
    try:
        i, j, num_i, num_j = map(int, value)
        return Area(i=i, j=j, num_i=num_i, num_j=num_j)
    except (TypeError, ValueError, WireError):
        raise TrustFileError(f"{place}: area is [i, j, num_i, num_j]; got {shorten(value)}.") from None


def _read_issuer(place: str, row: Mapping[str, Any]) -> NamedCertificate:
    _check_names(place, row, {"name", "certificate"})
    try:
        return NamedCertificate(_read_name(place, row), Certificate.read(bytes.fromhex(str(row.get("certificate")))))
    except (ValueError, WireError) as error:
        raise TrustFileError(f"{place}: certificate is not one ({error})") from None


def _read_revoked(row: Any) -> Revocations:
    if not isinstance(row, dict):
        raise TrustFileError(f"revoked needs a table [revoked]; got {shorten(row)}.")
    _check_names("revoked", row, {"signers", "issuers", "updated", "next"})
    updated_s = _read_time("revoked: updated", row["updated"]) if "updated" in row else 0.0
    next_s = _read_time("revoked: next", row["next"]) if "next" in row else None
    return Revocations(_read_identifiers(row, "signers"), _read_identifiers(row, "issuers"), updated_s, next_s)


def _read_identifiers(row: Mapping[str, Any], name: str) -> frozenset[bytes]:
    values = row.get(name, [])
    if not isinstance(values, list):
        raise TrustFileError(f"revoked: {name} is a list of identifiers; got {shorten(values)}.")
    return frozenset(_read_hex(f"revoked: {name}", value, IDENTIFIER_BYTES) for value in values)


def _check_names(place: str, row: Mapping[str, Any], known: set[str]) -> None:
    unknown = sorted(set(row) - known)
    if unknown:
        raise TrustFileError(f"{place} has an unknown field {unknown[0]!r}; known are {', '.join(sorted(known))}.")


def _read_name(place: str, row: Mapping[str, Any]) -> str:
    name = row.get("name")
    if not isinstance(name, str) or not 0 < len(name) <= 64 or set(name) - _NAME_CHARACTERS:
        raise TrustFileError(f"{place}: name has 1 to 64 letters, digits, spaces, - _ .; got {shorten(name)}.")
    return name


def _read_hex(place: str, value: Any, num_bytes: int) -> bytes:
    try:
        data = bytes.fromhex(value)
    except (TypeError, ValueError):
        data = b""
    if len(data) != num_bytes:
        raise TrustFileError(f"{place} has {2 * num_bytes} hexadecimal digits; got {shorten(value)}.")
    return data


def _read_time(place: str, value: Any) -> float:
    if not isinstance(value, datetime) or value.tzinfo is None:
        raise TrustFileError(f"{place} is a time such as 2026-12-31T00:00:00Z; got {shorten(value)}.")
    return value.timestamp()


def _format_time(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _format_list(identifiers: frozenset[bytes]) -> str:
    return "[" + ", ".join(f'"{one.hex()}"' for one in sorted(identifiers)) + "]"
