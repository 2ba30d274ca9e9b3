"""Versions to and from a remote: hashed on arrival on both ways, fetched when missing, never at the cost of history."""

import uuid
from pathlib import Path

import fsspec
import pytest

from mineloc.errors import StoreError
from mineloc.store.datasets import Datasets
from mineloc.store.exchange import pull, push
from mineloc.store.remote import Remote
from mineloc.store.store import Store

pytestmark = pytest.mark.usefixtures("no_flush")


@pytest.fixture(params=["memory", "file"])
def remote(request, tmp_path):
    if request.param == "file":
        return Remote(f"file://{tmp_path}/nas/store")
    return Remote(f"memory://{uuid.uuid4().hex}/store")


@pytest.fixture
def here(tmp_path):
    return filled(tmp_path / "here")


def recording(folder: Path, content: bytes) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "r.mcap").write_bytes(content)
    return folder / "r.mcap"


def filled(root: Path) -> Datasets:
    made = Datasets(Store(root / "store"))
    (root / "bag").mkdir()
    (root / "bag" / "0.db3").write_bytes(b"x" * 500)
    made.add("mine", {"a": recording(root, b"points")}, health={"a": {"duration_s": 2.0}})
    made.add("mine", {"b": root / "bag"})
    made.tag("mine", "good")
    return made


def there(tmp_path: Path, name: str = "there") -> Datasets:
    return Datasets(Store(tmp_path / name / "store"))


def lying(remote: Remote, digest: str) -> str:
    return f"{remote._root}/objects/{digest[:2]}/{digest}"


@pytest.mark.parametrize("reference", ["mine", "mine@good"])
def test_what_is_pushed_is_pulled(here, remote, tmp_path, reference):
    pushed = push(here, reference, remote)
    # two manifests, a, its report, the bag's tree and its file
    assert (pushed.version, pushed.objects) == (here.get("mine"), 6)
    assert push(here, reference, remote).objects == 0
    other = there(tmp_path)
    pulled = pull(other, reference, remote)
    assert (pulled.version, pulled.objects) == (pushed.version, 6)
    assert other.get(reference) == other.get("mine") == pushed.version
    assert other.verify().is_sound
    assert {r.flight: other.store.source(other.path(r)) for r in pulled.version.recordings} == {
        r.flight: r.ref for r in pushed.version.recordings
    }
    assert pull(other, reference, remote).objects == 0
    by_id = pull(there(tmp_path, "third"), f"mine@{pushed.version.id}", remote)
    assert by_id.version == pushed.version


def test_nothing_half_sent_stays_at_the_remote(here, remote, tmp_path):
    push(here, "mine", remote)
    fs, root = fsspec.core.url_to_fs(remote.url)
    assert [p for p in fs.find(f"{root}/tmp")] == []  # noqa: C416  # find gives a list or a dict
    assert len(fs.find(f"{root}/objects")) == 6


def test_what_is_damaged_at_the_remote_is_not_taken(here, remote, tmp_path):
    version = push(here, "mine", remote).version
    fs, _ = fsspec.core.url_to_fs(remote.url)
    for one in (version.recordings[0].sha256, version.id):
        good = fs.cat_file(lying(remote, one))
        fs.pipe_file(lying(remote, one), good[:-1] + b"?")
        other = there(tmp_path)
        with pytest.raises(StoreError, match="damaged; expected an intact object") as error:
            pull(other, "mine", remote)
        assert "\n" not in str(error.value)
        assert other.store.objects.digests() == []
        assert other.list() == []
        fs.pipe_file(lying(remote, one), good)
    fs.rm_file(lying(remote, version.id))
    with pytest.raises(StoreError, match="not there"):
        pull(there(tmp_path), "mine", remote)
    assert push(here, "mine", remote).objects == 1
    pull(there(tmp_path), "mine", remote)


def test_what_is_damaged_here_is_not_sent(here, remote):
    version = here.get("mine")
    path = here.store.objects.path(version.recordings[0].sha256)
    path.chmod(0o644)
    path.write_bytes(b"p0ints")
    with pytest.raises(StoreError, match="damaged"):
        push(here, "mine", remote)
    assert not remote.has(version.recordings[0].sha256, 6)
    assert remote.read_ref("mine", "latest") is None, "a reference is set when all that it reaches is there"


def test_what_arrives_damaged_is_taken_away_again(here, remote, monkeypatch):
    monkeypatch.setattr(Remote, "_hash", lambda *_: "0" * 64)
    with pytest.raises(StoreError, match="arrived damaged"):
        push(here, "mine", remote)
    fs, root = fsspec.core.url_to_fs(remote.url)
    assert [path for path in fs.find(root) if "latest" not in path] == []


def test_a_missing_or_damaged_object_is_fetched_when_it_is_read(here, remote, tmp_path):
    version = push(here, "mine", remote).version
    remote.remember(here.store.root)
    again = Datasets(Store(here.store.root))
    assert again.remote is not None
    a, bag = version.recordings
    here.store.objects.path(a.sha256).unlink()
    tree = here.store.objects.path(bag.sha256)
    file = here.store.objects.path(here.store.objects.files(bag.ref)["0.db3"])
    tree.unlink()
    file.chmod(0o644)
    file.write_bytes(b"damaged")
    here.store.objects.path(version.id).unlink()
    assert again.path(again.get("mine").recordings[0]).read_bytes() == b"points"
    assert (again.path(bag) / "0.db3").read_bytes() == b"x" * 500
    assert again.verify().is_sound
    here.store.objects.path(a.sha256).unlink()
    fs, _ = fsspec.core.url_to_fs(remote.url)
    fs.rm_file(lying(remote, a.sha256))
    with pytest.raises(StoreError, match="gone or damaged"):
        again.path(a)


def test_history_is_lost_on_neither_side(here, remote, tmp_path):
    push(here, "mine", remote)
    other = there(tmp_path)
    other.add("mine", {"z": recording(tmp_path / "in", b"z")})
    with pytest.raises(StoreError, match="does not follow the remote's latest"):
        push(other, "mine", remote)
    with pytest.raises(StoreError, match="whose history would be lost"):
        pull(other, "mine", remote)
    assert pull(other, "mine", remote, name="theirs").version == other.get("theirs") == here.get("mine")
    third = there(tmp_path, "third")
    pull(third, "mine", remote)
    newer = third.add("mine", {"z": recording(tmp_path / "in", b"z")})
    push(third, "mine", remote)
    assert remote.read_ref("mine", "latest") == newer.id
    pull(here, "mine", remote)
    assert here.get("mine") == newer
    # an older version may be pushed with its tag; latest stays
    push(here, "mine@good", remote)
    assert (remote.read_ref("mine", "latest"), remote.read_ref("mine", "tags/good")) == (newer.id, newer.parent)


def test_remotes_that_cannot_be_used_are_told_in_one_line(here, remote, tmp_path):
    with pytest.raises(StoreError, match="no URL"):
        Remote("/mnt/nas")
    for url in ("nosuch://x/y", "s3://bucket/x"):
        with pytest.raises(StoreError, match=r"install|check URL") as error:
            push(here, "mine", Remote(url))
        assert "\n" not in str(error.value)
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="check URL and access"):
        push(here, "mine", Remote(f"file://{tmp_path}/file/store"))
    with pytest.raises(StoreError, match="no such version"):
        pull(there(tmp_path), "mine", remote)
    push(here, "mine", remote)
    with pytest.raises(StoreError, match="no such version"):
        pull(there(tmp_path), "mine@nope", remote)
    fs, _ = fsspec.core.url_to_fs(remote.url)
    fs.pipe_file(remote._ref("mine", "latest"), b"nonsense")
    with pytest.raises(StoreError, match="a damaged reference"):
        pull(there(tmp_path), "mine", remote)
