"""The official ModelNet archives: downloaded by TFDS and checked, or a file that is here already."""

from __future__ import annotations

import hashlib
import os
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path

from data_pipeline.errors import DataError
from data_pipeline.progress import console

_ANSWER_WITHIN = 20.0
"""Seconds in which a server has to say that it has the file; TFDS by itself would try for minutes."""


@dataclass(frozen=True)
class Archive:
    """A file that others publish.

    Attributes:
        name: of the data set.
        url: where it is.
        sha256: of the file.
        size: in bytes; None where only its server knows.
        classes, train, test: how many of each it holds.
    """

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
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def download_folder() -> Path:
    """Where TFDS keeps its downloads: `$TFDS_DATA_DIR/downloads`, or in the home directory."""
    return Path(os.environ.get("TFDS_DATA_DIR", "~/tensorflow_datasets")).expanduser() / "downloads"


def download(archive: Archive, folder: Path) -> Path:
    """Downloads an archive into `folder` with TFDS, unless it is there, and checks its size and SHA-256.

    Raises:
        DataError: where it cannot be had, or is not the file that it should be.
    """
    import requests
    import tensorflow_datasets as tfds
    from tensorflow_datasets.core.download.checksums import UrlInfo
    from tensorflow_datasets.core.download.download_manager import NonMatchingChecksumError

    for there in (folder / archive.name.lower()).glob("*.zip"):
        if sha256(there) == archive.sha256:
            return there
    advice = f"fetch {archive.url} by other means and name the file with --archive"
    try:
        with urllib.request.urlopen(
            urllib.request.Request(archive.url, method="HEAD"), timeout=_ANSWER_WITHIN
        ) as answer:
            size = archive.size or int(answer.headers["Content-Length"])
        tfds.disable_progress_bar()
        console.print(
            f"Downloading {archive.name}, {size / 1e6:,.0f} MB, to {folder}; it is for academic research only"
        )
        manager = tfds.download.DownloadManager(
            download_dir=folder,
            dataset_name=archive.name.lower(),
            url_infos={archive.url: UrlInfo(size, archive.sha256, archive.url.rsplit("/", 1)[-1])},
            force_checksums_validation=True,
        )
        return Path(manager.download(archive.url))
    except NonMatchingChecksumError as error:
        raise DataError(
            f"what {archive.url} gave is not {archive.name}: its size or SHA-256 is another; {advice}"
        ) from error
    except (urllib.error.URLError, requests.RequestException, OSError, TypeError) as error:
        reason = str(getattr(error, "reason", error)).splitlines()[0]
        raise DataError(f"{archive.name} could not be downloaded ({reason}); {advice}") from error


def local(archive: Archive, path: Path) -> Path:
    """A file that is taken for the archive; said if it is another.

    Raises:
        DataError: where there is no such file.
    """
    try:
        digest = sha256(path)
    except OSError as error:
        raise DataError(f"--archive {path} cannot be read: {error.strerror}") from error
    if digest != archive.sha256:
        console.print(
            f"{path} is not the official {archive.name} (SHA-256 {digest[:16]}…); taken as it is", style="dim"
        )
    return path
