"""preview.html is written beside a new case and by a check; a file that is not ours is never replaced."""

from __future__ import annotations

import json

import pytest

import palpate
from palpate.body.cost import expected_cost
from palpate.body.read import read_states
from palpate.cli import main
from palpate.errors import ConfigurationError
from palpate.progress import Forecast
from palpate.report.preview import GENERATOR


def new_case(folder, names="names.json"):
    images = [folder / f"{name}.nii.gz" for name in ("before", "after")]
    return palpate.init(*images, labels=folder / names, output=folder / "case")


def test_a_new_case_has_its_preview_beside_it(folder):
    new_case(folder)
    page = (folder / "case" / "preview.html").read_text(encoding="utf-8")
    assert GENERATOR in page
    assert "There is no prediction yet" in page
    new_case(folder)  # whose preview is our own


@pytest.mark.parametrize(
    ("names", "expected"), [(("sub-01_full", "sub-01_empty"), "sub-01"), (("before", "after"), "anna")]
)
def test_a_new_case_is_called_by_its_images_or_their_folder(folder, names, expected):
    place = folder / "anna"
    place.mkdir()
    images = [place / f"{name}.nii.gz" for name in names]
    for name, image in zip(("before", "after"), images, strict=True):
        (folder / f"{name}.nii.gz").rename(image)
    case = palpate.init(*images, labels=folder / "names.json", output=folder / "case")
    assert palpate.read_case(case.path).id == expected


def test_init_check_and_estimate_first_predict_the_same_cost(folder):
    """On the images that they share; a range, which holds what is predicted once the mesh is made."""
    case = palpate.read_case(new_case(folder).path)
    page = (folder / "case" / "preview.html").read_text(encoding="utf-8")
    checked, estimated = list[str](), list[str]()
    meshed = palpate.check(case, progress=checked.append).cost

    def until_the_forecast(sentence: str) -> None:
        """Hear what an estimate says up to there."""
        estimated.append(sentence)
        if isinstance(sentence, Forecast):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        palpate.estimate(case, progress=until_the_forecast)
    first = next(sentence for sentence in checked if sentence.startswith("an estimate takes "))
    assert estimated[-1] == first
    states = read_states(case)
    guessed = expected_cost(case, states.before, states.after, n_pairs=1)
    assert first == guessed.sentence
    assert f"<dd>{guessed.time_words} on " in page
    assert f"<dd>{guessed.memory_words}</dd>" in page
    least, most = guessed.between
    assert least.unknowns < guessed.unknowns < most.unknowns
    assert least.seconds < guessed.seconds < most.seconds
    assert least.memory_gb < guessed.memory_gb < most.memory_gb
    assert meshed.between is None
    assert meshed.in_words != guessed.in_words


def test_what_init_must_ask_stands_in_the_preview(folder):
    (folder / "names.json").write_text(json.dumps({"1": "prostate", "2": "colon", "3": "body"}))
    case = new_case(folder)
    page = (folder / "case" / "preview.html").read_text(encoding="utf-8")
    assert case.questions
    assert "An estimate would refuse this case." in page


def test_a_preview_of_somebody_else_is_left_alone(folder):
    (folder / "case").mkdir()
    (folder / "case" / "preview.html").write_text("<p>mine</p>")
    with pytest.raises(ConfigurationError, match="no preview that Palpate wrote"):
        new_case(folder)
    assert [path.name for path in (folder / "case").iterdir()] == ["preview.html"]


def test_a_check_writes_the_page_and_predicts(folder, capsys):
    case = new_case(folder)
    page = folder / "pages" / "look.html"
    cheap = ("mesh.edge_length_mm=8", "mechanics.element=P1", "driver.modes=6")
    flags = [flag for setting in cheap for flag in ("--set", setting)]
    code = main(["check", str(case.path), "--html", str(page), "--json", *flags])
    document = json.loads(capsys.readouterr().out)
    assert code == document["exit_code"] == 0
    assert GENERATOR in page.read_text(encoding="utf-8")
    (modulus,) = document["predicted"]["moduli"]
    assert modulus["tissue"] == "prostate"
    assert page.read_text(encoding="utf-8").count("predicted: ") == 1
    assert [path.name for path in page.parent.iterdir()] == ["look.html"]


@pytest.mark.parametrize("name", ["case.toml", "notes.html"])
def test_a_check_replaces_no_file_of_another_kind(folder, name):
    case = new_case(folder)
    (folder / "notes.html").write_text("<p>mine</p>")
    kept = {path: path.read_bytes() for path in (case.path, folder / "notes.html")}
    where = case.path if name == "case.toml" else folder / name
    with pytest.raises(ConfigurationError):
        palpate.check(case.path, html=where)
    assert {path: path.read_bytes() for path in kept} == kept


def test_a_case_that_is_refused_has_a_page_without_prediction(folder):
    case = new_case(folder)
    found = palpate.check(case.path, ["images.before=none.nii.gz"], html=folder / "look.html")
    assert found.exit_code == 3
    assert found.predicted is None
    assert "the problems come first" in (folder / "look.html").read_text(encoding="utf-8")


def test_without_a_name_the_page_of_a_check_lies_beside_the_case(tmp_path, capsys):
    path = tmp_path / "case.toml"
    path.write_text('[images]\nbefore = "nowhere.nii.gz"\nafter = ["nowhere.nii.gz"]\n')
    assert main(["check", str(path), "--html"]) > 0
    assert capsys.readouterr().out.splitlines()[-1] == f"open {tmp_path / 'preview.html'}"
    assert (tmp_path / "preview.html").is_file()
    with pytest.raises(SystemExit):
        main(["check", "--html", str(path)])
    assert "CASE.TOML; give it before the options" in capsys.readouterr().err
