"""Systems on the Hugging Face hub, of which a local server stands in for the real one."""

from __future__ import annotations

import hashlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

import mevs_jax
from mevs_jax.trained import save
from tests.mevs_jax.trained import making

NAME, COMMIT = "somebody/furniture", "0" * 39 + "1"


def has_hub():
    try:
        import huggingface_hub  # noqa: F401
    except ImportError:
        return False
    return True


@pytest.mark.skipif(has_hub(), reason="huggingface_hub is installed")
def test_without_the_package_one_sentence_says_what_to_install():
    with pytest.raises(ImportError, match=r"install huggingface_hub: pip install mevs-jax\[hub\]"):
        mevs_jax.load(f"hf://{NAME}")


def test_a_missing_path_never_asks_the_hub(monkeypatch):
    def ask(*_):
        raise AssertionError("the hub was asked")

    monkeypatch.setattr("mevs_jax.trained.files._from_hub", ask)
    with pytest.raises(FileNotFoundError, match=rf"no folder {NAME}, and no system .* hub is hf://{NAME}$"):
        mevs_jax.load(NAME)
    monkeypatch.undo()
    with pytest.raises(FileNotFoundError, match="is owner/name, got"):
        mevs_jax.load("hf://../../etc")


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """A hub with one model; returns the paths that were asked for."""
    pytest.importorskip("huggingface_hub", reason="systems on the hub need huggingface_hub")
    from huggingface_hub import constants

    made = making.system()
    save(made, tmp_path / "system")
    files = {path.name: path.read_bytes() for path in (tmp_path / "system").iterdir()} | {"pickle.bin": b"not wanted"}
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_):
            pass

        def do_HEAD(self):
            self.answer(False)

        def do_GET(self):
            self.answer(True)

        def answer(self, body):
            import json

            asked.append(self.path)
            path = self.path.split("?")[0]
            if path.startswith(f"/api/models/{NAME}"):
                content = json.dumps(
                    {
                        "id": NAME,
                        "sha": COMMIT,
                        "siblings": [{"rfilename": name, "size": len(of)} for name, of in files.items()],
                    }
                    if "/tree/" not in path
                    else [{"type": "file", "path": name, "size": len(of), "oid": "0"} for name, of in files.items()]
                ).encode()
                kind = "application/json"
            elif path.startswith(f"/{NAME}/resolve/") and path.rsplit("/", 1)[1] in files:
                content, kind = files[path.rsplit("/", 1)[1]], "application/octet-stream"
            else:
                self.send_response(404)
                self.send_header("X-Error-Code", "RepoNotFound")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("ETag", f'"{hashlib.sha256(content).hexdigest()}"')
            self.send_header("X-Repo-Commit", COMMIT)
            self.end_headers()
            if body:
                self.wfile.write(content)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    endpoint = f"http://127.0.0.1:{server.server_port}"
    for name, value in {
        "ENDPOINT": endpoint,
        "HUGGINGFACE_CO_URL_TEMPLATE": endpoint + "/{repo_id}/resolve/{revision}/{filename}",
        "HF_HUB_CACHE": str(tmp_path / "cache"),
        "HF_HUB_DISABLE_XET": True,
    }.items():
        monkeypatch.setattr(constants, name, value)
    import huggingface_hub.hf_api as hf_api

    monkeypatch.setattr(hf_api.api, "endpoint", endpoint)
    monkeypatch.chdir(tmp_path)
    yield made, asked
    server.shutdown()


def test_a_system_is_loaded_from_the_hub(hub):
    made, asked = hub
    read = mevs_jax.load(f"hf://{NAME}")
    assert read.description == made.description
    assert read.name == f"hf://{NAME}"
    assert not any("pickle.bin" in path and "resolve" in path for path in asked)
    assert mevs_jax.from_pretrained(NAME, revision="main").classes == made.classes
    assert mevs_jax.from_pretrained(f"hf://{NAME}").classes == made.classes
    with pytest.raises(FileNotFoundError, match="the Hugging Face hub did not give a model of the name somebody/else"):
        mevs_jax.load("hf://somebody/else")
