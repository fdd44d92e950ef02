# SPDX-License-Identifier: Apache-2.0
"""Keys and certificates on disk: private, whole, and what their commands print."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest
from tests.runtime.conftest import START_S, Federation

from manyeyes.cli import main as cli
from manyeyes.datatypes import ConfigError
from manyeyes.runtime import federation as files
from manyeyes.runtime.keys import Identity, KeyFileError, generate_key, load_key, public_bytes, save_key
from manyeyes.runtime.pseudonyms import CHANGE_PERIOD_NS, SILENCE_NS, PseudonymPool
from manyeyes.runtime.trust_file import Trust, TrustFileError


def run(*words: object) -> int:
    return cli.main([str(word) for word in words])


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    files.make_demo_federation(tmp_path / "keys", (1, 2))
    return tmp_path / "keys"


def test_private_keys_are_readable_by_their_owner_only_from_the_beginning(tmp_path, monkeypatch) -> None:
    modes, real = [], os.fdopen
    monkeypatch.setattr(os, "fdopen", lambda fd, *rest: modes.append(os.fstat(fd).st_mode) or real(fd, *rest))
    old = os.umask(0)
    try:
        save_key(tmp_path / "a.key", generate_key())
    finally:
        os.umask(old)
    modes.append((tmp_path / "a.key").stat().st_mode)
    assert [stat.S_IMODE(mode) for mode in modes] == [0o600, 0o600]
    assert [path.name for path in tmp_path.iterdir()] == ["a.key"]


def test_a_key_that_fails_to_be_written_leaves_nothing(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(os, "fdopen", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError):
        save_key(tmp_path / "a.key", generate_key())
    assert list(tmp_path.iterdir()) == []


def test_a_key_that_others_may_read_is_refused(tmp_path) -> None:
    path = tmp_path / "a.key"
    save_key(path, generate_key())
    path.chmod(0o640)
    with pytest.raises(KeyFileError, match=r"mode 0640.*chmod 600"):
        load_key(path)


def test_a_pass_phrase_encrypts(tmp_path) -> None:
    path, key = tmp_path / "a.key", generate_key()
    save_key(path, key, b"secret")
    assert b"ENCRYPTED" in path.read_bytes() and public_bytes(load_key(path, b"secret")) == public_bytes(key)
    for wrong in (None, b"other"):
        with pytest.raises(KeyFileError, match="pass phrase"):
            load_key(path, wrong)


def test_a_certificate_of_another_key_is_refused(keys: Path) -> None:
    (keys / "agent-1.cert").write_bytes((keys / "agent-2.cert").read_bytes())
    with pytest.raises(ConfigError, match="another key"):
        Identity.load(keys / "agent-1.key")


def test_a_trust_file_round_trips_and_names_the_field_that_is_wrong(federation: Federation) -> None:
    text = federation.trust.to_toml()
    assert Trust.parse(text) == federation.trust and len(federation.trust.grantors()) == 2
    wrong = {
        "until is a time": text.replace("until = ", "until = 3 #"),
        "rights are some of": text.replace('"objects"', '"everything"'),
        "key has 64 hexadecimal": text.replace('key = "', 'key = "zz'),
        "unknown field 'keys'": "keys = 1\n" + text,
        "certificate is not one": text.replace('certificate = "', 'certificate = "00'),
        "signers has 16 hexadecimal": text.replace("signers = []", 'signers = ["00"]'),
        "not a TOML file": "[[anchor",
        "name has 1 to 64": text.replace('name = "anchor"', 'name = "a\\"b"'),
    }
    for expected, bad in wrong.items():
        with pytest.raises(TrustFileError, match=expected):
            Trust.parse(bad)


def test_an_issuer_that_no_anchor_has_signed_is_not_admitted(federation: Federation) -> None:
    other = Federation.make()
    mixed = Trust(federation.trust.anchors, other.trust.issuers)
    assert set(mixed.grantors()) == {federation.trust.anchors[0].identifier}


def test_pseudonyms_change_after_a_silent_period_and_begin_again(federation: Federation) -> None:
    pool, begin = PseudonymPool([federation.identity(k) for k in (11, 12)], seed=3), START_S * 10**9
    assert pool.identity(begin).agent_id == 11 == pool.identity(begin + CHANGE_PERIOD_NS - 1).agent_id
    changed, ids = begin + CHANGE_PERIOD_NS, list[int]()
    for _ in range(2):
        assert pool.identity(changed) is None and pool.identity(changed + SILENCE_NS[0] - 1) is None
        after = changed + SILENCE_NS[1]
        ids.append(pool.identity(after).agent_id)
        changed = after + CHANGE_PERIOD_NS
    assert ids == [12, 11]


def test_a_single_identity_is_never_silent(federation: Federation) -> None:
    pool = PseudonymPool([federation.identity(11)])
    times = (START_S * 10**9 + k * CHANGE_PERIOD_NS for k in range(3))
    assert {pool.identity(t).agent_id for t in times} == {11}


def test_commands_make_a_federation_and_end_trust(tmp_path: Path, capsys) -> None:
    keys = tmp_path / "keys"
    assert run("keys", "anchor", "--out", keys) == 0
    assert run("keys", "issue", keys / "issuer", "--kind", "issuer", "--issuer", keys / "anchor.key") == 0
    assert (
        run("keys", "issue", keys / "a", "--issuer", keys / "issuer.key", "--agent-id", 7, "--rights", "objects") == 0
    )
    assert run("keys", "pool", "--out", tmp_path / "pool", "--issuer", keys / "issuer.key", "--count", 3) == 0
    ids = {Identity.load(path).agent_id for path in (tmp_path / "pool").glob("*.key")}
    assert len(ids) == 3 and len(list((tmp_path / "pool").iterdir())) == 6
    assert run("keys", "verify", keys / "a.cert", "--trust", keys / "trust.toml") == 0
    capsys.readouterr()
    assert run("keys", "show", keys / "a.cert") == 0
    shown = capsys.readouterr().out
    assert "agent id    7" in shown and "rights      objects" in shown and "anywhere" in shown
    assert run("keys", "revoke", keys / "a.cert", "--trust", keys / "trust.toml") == 0
    assert run("keys", "verify", keys / "a.cert", "--trust", keys / "trust.toml") == 1
    assert "it is revoked" in capsys.readouterr().err
    assert run("keys", "revoke", keys / "issuer.cert", "--trust", keys / "trust.toml") == 0
    assert run("keys", "trust", keys / "trust.toml") == 0
    listed = capsys.readouterr().out
    assert "anchor" in listed and "NOT ADMITTED" in listed and listed.count("revoked ") == 2


def test_commands_overwrite_no_key_and_fail_in_one_line(keys: Path, capsys) -> None:
    before = (keys / "anchor.key").read_bytes()
    assert run("keys", "demo", "--out", keys) == 1 == run("keys", "anchor", "--out", keys)
    assert run("keys", "issue", keys / "agent-1", "--issuer", keys / "issuer.key") == 1
    assert run("keys", "issue", keys / "x", "--issuer", keys / "agent-1.key") == 1
    assert run("keys", "show", keys / "anchor.key") == 1
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 5 and "no right to issue" in errors[3] and "no certificate" in errors[4]
    assert (keys / "anchor.key").read_bytes() == before and not (keys / "x.key").exists()
