"""model.npz, which every estimate leaves beside its result: what `palpate export` makes the files of others from."""

from __future__ import annotations

from pathlib import Path

from palpate.errors import EstimationError, InputDataError
from palpate.export.fitted_model import FittedModel
from palpate.images.named_labels import printable
from palpate.statement.result import SCHEMA
from palpate.study.archive import read_archive, write_archive
from palpate.study.earlier import seal_of
from palpate.study.outputs import RESULT, read_json, sha256_of

MODEL = "model.npz"
FORMAT = "palpate.model/1"


def write_model(model: FittedModel, path: Path) -> None:
    """Write the model of a result to `path`; raises `ResourceError` when the disk refuses."""
    write_archive(model, path, version=FORMAT)


def read_model(folder: Path) -> FittedModel:
    """The model of the estimate that wrote `folder`.

    Raises `InputDataError` where a file of that run is missing, or was changed since, or another version wrote it,
    `EstimationError` where the estimate did not converge.
    """
    path = folder / RESULT
    document = read_json(path)
    if document.get("schema") != SCHEMA:
        schema = printable(str(document.get("schema"))[:40])
        raise InputDataError(
            f"{path} has the schema '{schema}', this version of Palpate reads '{SCHEMA}': run the estimate again"
        )
    if document.get("status") != "converged":
        raise EstimationError(
            f"{path} is of an estimate with the status '{printable(str(document.get('status'))[:40])}'; only converged"
            " estimates can be exported"
        )
    files = document.get("files", {})
    if MODEL not in files:
        raise InputDataError(
            f"{path} is of a run without {MODEL}, from which exports are made; run the estimate again with this version"
        )
    for name, entry in files.items():
        own = folder / name
        if Path(name).name != name or own.is_symlink() or not own.is_file():
            raise InputDataError(
                f"{folder} is incomplete: the file '{printable(name)}', which its {RESULT} lists, is not there; run the"
                " estimate again"
            )
        if sha256_of(own) != entry["sha256"]:
            raise InputDataError(
                f"{own} was changed after the estimate of {RESULT} (its SHA-256 differs); run the estimate again, into"
                " another folder"
            )
    model = read_archive(FittedModel, folder / MODEL, version=FORMAT, sha256=files[MODEL]["sha256"])
    if model.seal != seal_of(document):
        raise InputDataError(
            f"the numbers in {path} are not those of the run that wrote {MODEL}: one of them was changed; run the"
            " estimate again"
        )
    for body in model.bodies:
        if {len(motion) for motion in body.displacements} != {len(body.space.points)}:
            raise InputDataError(
                f"{folder / MODEL} holds displacements of other points than its mesh has; run the estimate again"
            )
    return model
