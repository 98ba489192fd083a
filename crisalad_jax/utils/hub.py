"""Files at Hugging Face's hub and at Kaggle, through their own clients."""

import contextlib
import dataclasses
import os
import pathlib
import re
import sys
from collections.abc import Iterator

from crisalad_jax.utils.download import OFFLINE, is_offline
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.extras import missing_extra

PREFIX = "hf://"
_KAGGLE_CACHE = "KAGGLEHUB_CACHE"
"""Environment variable: where Kaggle's client stores what it downloads."""
_ADDRESS = re.compile(
    # A `Path` turns two slashes into one.
    r"hf:/{1,2}(?P<repository>[\w.-]+/[\w.-]+)(@(?P<revision>[^/@]+))?(/(?P<file>.+))?/?"
)


@dataclasses.dataclass(frozen=True)
class HubAddress:
    """A repository at Hugging Face's hub, or a file in it."""

    repository: str
    """Owner and name, as OWNER/NAME."""
    revision: str | None = None
    """Branch, tag or commit; None is the main branch."""
    file: str | None = None

    def __str__(self) -> str:
        """Return the address as hf://OWNER/NAME[@REVISION][/FILE]."""
        at = f"@{self.revision}" if self.revision else ""
        return f"{PREFIX}{self.repository}{at}{f'/{self.file}' if self.file else ''}"


def is_hub(address: object) -> bool:
    """Return whether a path or a text is an address at the hub.

    Example:
        >>> is_hub("hf://owner/name"), is_hub("owner/name")
        (True, False)
    """
    return str(address).startswith("hf:/")


def parse_hub(address: object) -> HubAddress:
    """Parse an address at the hub: hf://OWNER/NAME, optionally with @REVISION and /FILE.

    Raises:
        InputError: `address` is not such an address.

    Example:
        >>> parse_hub("hf://owner/name@v1/model.safetensors")
        HubAddress(repository='owner/name', revision='v1', file='model.safetensors')
    """
    found = _ADDRESS.fullmatch(str(address))
    if found is None:
        raise InputError(
            f"{address}: found no address at the hub, expected hf://OWNER/NAME[@REVISION][/FILE]"
        )
    return HubAddress(found["repository"], found["revision"], found["file"])


def download_file(
    address: HubAddress,
    *,
    is_dataset: bool = False,
    folder: pathlib.Path | None = None,
    quiet: bool = False,
) -> pathlib.Path:
    """Download a file from the hub, or find it in the hub's cache.

    Args:
        address: the repository and the file.
        is_dataset: whether it is a repository of a data set, not of a model.
        folder: where to store the file, under its path in the repository; None is the hub's cache.
        quiet: whether to hide the progress bar.

    Returns:
        The file.

    Raises:
        InputError: there is no such repository, revision or file; access is denied; the hub does
            not answer; or the network is disabled and the cache has no such file.
        ModuleNotFoundError: huggingface_hub is not installed.
    """
    with _extra(address):
        import huggingface_hub

    with _told(address), _bars(quiet):
        return pathlib.Path(
            huggingface_hub.hf_hub_download(
                address.repository,
                str(address.file),
                repo_type="dataset" if is_dataset else "model",
                revision=address.revision,
                local_dir=folder,
                local_files_only=is_offline(),
            )
        )


def upload_folder(
    folder: pathlib.Path, address: HubAddress, message: str, *, quiet: bool = False
) -> str:
    """Upload a folder to a model repository that is new or has no files of the same names.

    Args:
        folder: the folder.
        address: the repository.
        message: the commit message.
        quiet: whether to hide the progress bar.

    Returns:
        The address of the repository's page.

    Raises:
        InputError: the repository has such files; the user is not logged in or may not write there;
            or the hub does not answer.
        ModuleNotFoundError: huggingface_hub is not installed.
    """
    if is_offline():
        raise InputError(f"{address}: {OFFLINE} forbids the network")
    with _extra(address):
        import huggingface_hub

    interface = huggingface_hub.HfApi()
    with _told(address), _bars(quiet):
        made = interface.create_repo(address.repository, exist_ok=True)
        there = interface.list_repo_files(address.repository, revision=address.revision)
        if taken := sorted(set(there) & {path.name for path in folder.iterdir()}):
            raise InputError(
                f"{address}: found a repository with {', '.join(taken)}, expected a new or empty "
                "one"
            )
        interface.upload_folder(
            repo_id=address.repository,
            folder_path=folder,
            commit_message=message,
            revision=address.revision,
        )
    return str(made)


def download_kaggle(handle: str, folder: pathlib.Path, *, quiet: bool = False) -> pathlib.Path:
    """Download a data set from Kaggle, unpacked.

    Args:
        handle: the data set, as OWNER/NAME.
        folder: a folder for the cache of Kaggle's client, from which the next call resumes.
        quiet: whether to hide the progress bar.

    Returns:
        The folder with the set's files, in the cache.

    Raises:
        InputError: there is no such set, the user has no token, or Kaggle does not answer.
        ModuleNotFoundError: kagglehub is not installed.
    """
    with _extra(f"kaggle: {handle}"):
        import kagglehub
    from unittest import mock  # rarely needed

    try:
        with (
            # The client rejects an output folder that is not empty, so nothing could be resumed.
            mock.patch.dict(os.environ, {_KAGGLE_CACHE: str(folder)}),
            open(os.devnull, "w") as nothing,
            contextlib.redirect_stderr(nothing if quiet else sys.stderr),
        ):
            return pathlib.Path(kagglehub.dataset_download(handle))
    except Exception as error:  # its client has errors of several packages
        raise InputError(
            f"kaggle: {handle}: found {_first_line(error)}, expected the data set (a token: "
            "https://www.kaggle.com/settings; the same command resumes)"
        ) from error


@contextlib.contextmanager
def _extra(what: object) -> Iterator[None]:
    """Name the extra of a client that is not installed."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(missing_extra(error, str(what)), name=error.name) from error


@contextlib.contextmanager
def _told(address: HubAddress) -> Iterator[None]:
    """Report the hub's errors in one line, without its client's advice on tokens."""
    from huggingface_hub import errors

    absent = f"{OFFLINE} forbids the network" if is_offline() else "the hub does not answer"
    known = {  # the first that fits: some are subclasses of others
        errors.GatedRepoError: "a gated repository, expected you to accept the terms on its page",
        errors.RepositoryNotFoundError: "no such repository, or a private one, expected one",
        errors.RevisionNotFoundError: "no such revision, expected one",
        errors.LocalEntryNotFoundError: f"none in the hub's cache: {absent}",
        errors.EntryNotFoundError: f"no {address.file} there, expected it",
        errors.LocalTokenNotFoundError: "no token, expected one",
    }
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # its client has errors of several packages
        words = next((words for kind, words in known.items() if isinstance(error, kind)), None)
        if words is None and isinstance(error, errors.HfHubHTTPError):
            code, reason = error.response.status_code, error.response.reason_phrase
            words = f"HTTP {code} {reason}, expected an answer"
        words = words or f"{_first_line(error)}, expected an answer"
        response = getattr(error, "response", None)
        denied = response is not None and response.status_code in (401, 403)
        advice = " (`hf auth login`)" if denied or "token" in words else ""
        raise InputError(f"{address}: found {words}{advice}") from error


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__


@contextlib.contextmanager
def _bars(quiet: bool) -> Iterator[None]:
    """Hide the clients' progress bars while the block runs, if `quiet`."""
    from huggingface_hub import utils

    with contextlib.ExitStack() as stack:
        if quiet and not utils.are_progress_bars_disabled():
            utils.disable_progress_bars()
            stack.callback(utils.enable_progress_bars)
        yield
