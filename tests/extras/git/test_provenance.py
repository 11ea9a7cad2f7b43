"""Where numbers come from: the commit of the checkout."""

import subprocess

import pytest

from simtest.runtime import provenance


@pytest.fixture
def git(tmp_path, monkeypatch):
    """A checkout that simtest takes for its own."""
    (tmp_path / "simtest").mkdir()
    monkeypatch.setattr(provenance, "_ROOT", tmp_path / "simtest")

    def call(*arguments):
        who = ["-c", "user.name=a", "-c", "user.email=a@example.com", "-c", "commit.gpgsign=false"]
        command = ["git", "-C", str(tmp_path), *who, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    return call


def test_the_commit_tells_whether_files_are_changed(git, tmp_path):
    # No checkout, then one without a commit.
    assert provenance.commit() is None
    git("init", "-q")
    assert provenance.commit() is None
    file = tmp_path / "a.txt"
    file.write_text("1")
    git("add", "a.txt")
    git("commit", "-q", "-m", "first")
    head = git("rev-parse", "HEAD")
    assert provenance.commit() == head
    file.write_text("2")
    assert provenance.commit() == head + "+"
    git("checkout", "-q", "a.txt")
    (tmp_path / "new.txt").write_text("not tracked")
    assert provenance.commit() == head + "+"
    # Off any branch.
    (tmp_path / "new.txt").unlink()
    git("checkout", "-q", "--detach")
    assert provenance.commit() == head
