"""Public pretrained weights: downloaded, checked, and converted to model files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from jaxmap.errors import JaxmapError, UsageError
from jaxmap.host.cache import cache_folder
from jaxmap.models.checkpoint import load_model, save_model
from jaxmap.models.importers import ImportedWeights, import_weights

TIMEOUT_S = 60.0


class PublicWeights(NamedTuple):
    """A file that can be downloaded.

    Attributes:
        url: where it lies.
        sha256: its checksum, or as many leading digits of it as are known.
        help: its content in words.
    """

    url: str
    sha256: str
    help: str


_TORCHVISION = "https://download.pytorch.org/models/"


def _torchvision(name: str, sha256: str, help: str) -> PublicWeights:
    # torchvision names its files by the first eight digits of their SHA-256.
    return PublicWeights(f"{_TORCHVISION}{name}-{sha256[:8]}.pth", sha256, help)


PUBLIC: dict[str, PublicWeights] = {
    "mobilenet_v2": _torchvision(
        "mobilenet_v2",
        "b03531047ffacf1e2488318dcd2aba1126cde36e3bfe1aa5cb07700aeeee9889",
        "torchvision MobileNetV2, ImageNet V1",
    ),
    "mobilenet_v2_v2": _torchvision(
        "mobilenet_v2",
        "7ebf99e03e254b273379b23edca7ec0da9f48273b23a332b93c1c99d49e86e8f",
        "torchvision MobileNetV2, ImageNet V2",
    ),
    "resnet18": _torchvision(
        "resnet18",
        "f37072fd47e89c5e827621c5baffa7500819f7896bbacec160b1a16c560e07ec",
        "torchvision ResNet-18, ImageNet V1",
    ),
    "resnet50": _torchvision(
        "resnet50",
        "0676ba61b6795bbe1773cffd859882e5e297624d384b6993f7c9e683e722fb8a",
        "torchvision ResNet-50, ImageNet V1",
    ),
    "resnet50_v2": _torchvision(
        "resnet50",
        "11ad3fa62ca79e40addfd354a8ec4b7c75143b3038b8d2a807fbc68deab379ca",
        "torchvision ResNet-50, ImageNet V2",
    ),
    "resnet101": _torchvision(
        "resnet101",
        "63fe2227b86e8f1f2063f43a75c84d195911b6a0eace650907dd3dc62dd49a0a",
        "torchvision ResNet-101, ImageNet V1",
    ),
    "resnet101_v2": _torchvision(
        "resnet101",
        "cd907fc2a0de2292b2ba2b27d2216bc672d84632d1cf20058d01c0c03b5e020e",
        "torchvision ResNet-101, ImageNet V2",
    ),
}
"""What `jaxmap weights fetch` knows, by name.

The publisher gives the first eight digits of each SHA-256, in the file's name. The other digits are those
that at least two independent projects have published for the same file.
"""


def convert_file(
    source: Path, out: Path, *, classes: Sequence[str] | None = None, output_stride: int | None = None
) -> ImportedWeights:
    """Converts a public checkpoint to a model file; the arguments are those of `import_weights`.

    Raises:
        JaxmapError: the source is of no known kind or does not fit, it would be overwritten, or
            writing failed.
    """
    _check_apart(source, out)
    imported = import_weights(source, classes=classes, output_stride=output_stride)
    save_model(out, imported.architecture, imported.weights, holds=imported.holds)
    return imported


def halve_file(source: Path, out: Path) -> None:
    """Writes a model file again in half precision.

    Raises:
        JaxmapError: the source is no whole model file, holds numbers too large for half precision or would be
            overwritten, or writing failed.
    """
    _check_apart(source, out)
    saved = load_model(source)
    save_model(out, saved.architecture, saved.weights, holds=saved.holds, half=True)


def _check_apart(source: Path, out: Path) -> None:
    if out.exists() and source.exists() and out.samefile(source):
        raise JaxmapError("the source would be overwritten", where=out, fix="choose another --out")


def fetch(name: str, *, mirror: str | None = None, notify: Callable[[str], None] = lambda line: None) -> Path:
    """Downloads a file of the table into the cache, checks it, and returns where it lies.

    A file that is there and whole is not downloaded again.

    Args:
        name: a key of `PUBLIC`.
        mirror: URL of a folder that holds the file under its own name, instead of the publisher's.
        notify: takes lines for the user.

    Raises:
        UsageError: an unknown name.
        JaxmapError: the server cannot be reached, or the file is not the one it should be.
    """
    import pooch

    if name not in PUBLIC:
        raise UsageError(f"no weights are called {name!r}", where="weights fetch", fix=f"known are {', '.join(PUBLIC)}")
    public = PUBLIC[name]
    file_name = public.url.rpartition("/")[2]
    url = public.url if mirror is None else f"{mirror.rstrip('/')}/{file_name}"
    folder = cache_folder() / "weights"
    target = folder / file_name
    if target.is_file() and _is_whole(target, public):
        return target
    target.unlink(missing_ok=True)
    notify(f"downloading {url}")
    pooch.get_logger().setLevel("ERROR")
    try:
        pooch.retrieve(
            url,
            known_hash=f"sha256:{public.sha256}" if len(public.sha256) == 64 else None,
            fname=file_name,
            path=folder,
            downloader=pooch.HTTPDownloader(timeout=TIMEOUT_S),  # type: ignore[arg-type]
        )
    except Exception as fault:
        reason = " ".join(str(fault).split())[:120] or type(fault).__name__
        raise JaxmapError(
            f"the download failed ({reason})",
            where=url,
            fix="download it elsewhere and run jaxmap weights import",
        ) from fault
    if not _is_whole(target, public):
        found = pooch.file_hash(str(target), alg="sha256")
        target.unlink()
        raise JaxmapError(
            f"the file's SHA-256 is {found[:16]}..., it should start with {public.sha256[:16]}",
            where=url,
            fix="try again, or download it elsewhere and run jaxmap weights import",
        )
    return target


def _is_whole(path: Path, public: PublicWeights) -> bool:
    import pooch

    return pooch.file_hash(str(path), alg="sha256").startswith(public.sha256)
