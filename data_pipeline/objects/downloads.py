"""The official ModelNet archives: downloaded with TFDS and verified, or read from a local file."""

from __future__ import annotations

import hashlib
import os
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path

from data_pipeline.errors import DataError
from data_pipeline.progress import console

_TIMEOUT = 20.0
"""Timeout in seconds of a first request to the server; without it, TFDS would retry for minutes."""


@dataclass(frozen=True)
class Archive:
    """A published data set in one file, of `size` bytes, or None if only the server knows it; and how much is in it."""

    name: str
    url: str
    sha256: str
    size: int | None
    classes: int
    train: int
    test: int


ARCHIVES = {
    "modelnet10": Archive(
        "ModelNet10",
        "http://3dvision.princeton.edu/projects/2014/3DShapeNets/ModelNet10.zip",
        "9d8679435fc07d1d26f13009878db164a7aa8ea5e7ea3c8880e42794b7307d51",
        473_402_300,
        classes=10,
        train=3991,
        test=908,
    ),
    "modelnet40": Archive(
        "ModelNet40",
        "http://modelnet.cs.princeton.edu/ModelNet40.zip",
        "42dc3e656932e387f554e25a4eb2cc0e1a1bd3ab54606e2a9eae444c60e536ac",
        None,
        classes=40,
        train=9843,
        test=2468,
    ),
}


def sha256(path: Path) -> str:
    """Returns the SHA-256 checksum of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def download_folder() -> Path:
    """Returns the download folder of TFDS: `$TFDS_DATA_DIR/downloads`, by default in `~/tensorflow_datasets`."""
    return Path(os.environ.get("TFDS_DATA_DIR", "~/tensorflow_datasets")).expanduser() / "downloads"


def download(archive: Archive, folder: Path) -> Path:
    """Returns the path of an archive in `folder`, downloaded with TFDS if it is not there, with size and SHA-256 verified.

    Raises:
        DataError: if the download fails, or the size or SHA-256 differs.
    """
    import requests
    import tensorflow_datasets as tfds
    from tensorflow_datasets.core.download.checksums import UrlInfo
    from tensorflow_datasets.core.download.download_manager import NonMatchingChecksumError

    for present in (folder / archive.name.lower()).glob("*.zip"):
        if sha256(present) == archive.sha256:
            return present
    advice = f"download {archive.url} by other means and pass the file with --archive"
    try:
        with urllib.request.urlopen(urllib.request.Request(archive.url, method="HEAD"), timeout=_TIMEOUT) as response:
            size = archive.size or int(response.headers["Content-Length"])
        tfds.disable_progress_bar()
        what = f"{archive.name}, {size / 1e6:,.0f} MB"
        console.print(f"Downloading {what}, to {folder}; it is for academic research only")
        manager = tfds.download.DownloadManager(
            download_dir=folder,
            dataset_name=archive.name.lower(),
            url_infos={archive.url: UrlInfo(size, archive.sha256, archive.url.rsplit("/", 1)[-1])},
            force_checksums_validation=True,
        )
        return Path(manager.download(archive.url))
    except NonMatchingChecksumError as error:
        differs = f"is not {archive.name}: its size or SHA-256 differs"
        raise DataError(f"the file at {archive.url} {differs}; {advice}") from error
    except (urllib.error.URLError, requests.RequestException, OSError, TypeError) as error:
        reason = str(getattr(error, "reason", error)).splitlines()[0]
        raise DataError(f"{archive.name} could not be downloaded ({reason}); {advice}") from error


def local(archive: Archive, path: Path) -> Path:
    """Returns `path`, a local copy of the archive; prints a note if its checksum is not the official one.

    Raises:
        DataError: if the file cannot be read.
    """
    try:
        digest = sha256(path)
    except OSError as error:
        raise DataError(f"--archive {path} cannot be read: {error.strerror}") from error
    if digest != archive.sha256:
        other = f"is not the official {archive.name} (SHA-256 {digest[:16]}…)"
        console.print(f"{path} {other}; it is used unchanged", style="dim")
    return path
