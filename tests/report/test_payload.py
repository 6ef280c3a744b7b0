"""What the page's scripts are given: the same geometry and images, in fewer bytes."""

from __future__ import annotations

import base64
import dataclasses
import json
import math
import zlib

import numpy as np
import pytest

from palpate.mechanics.element import largest_strains
from palpate.report.collect import collect
from palpate.report.payload import STRAIN_STEP, payload, script_json


@pytest.fixture(scope="module")
def data(case_result):
    return collect(case_result)


@pytest.fixture(scope="module")
def unpacked(data):
    packed = payload(data)
    return json.loads(packed.facts), zlib.decompress(base64.b64decode(packed.block))


def array(entry, block):
    dtype = np.dtype(entry["type"]).newbyteorder("<")
    assert entry["offset"] % 4 == 0
    values = np.frombuffer(block, dtype, math.prod(entry["shape"]), entry["offset"]).reshape(entry["shape"])
    return entry["low"] + entry["step"] * values if "low" in entry else values


def test_points_keep_their_place_to_a_hundredth_of_a_millimetre(data, unpacked):
    facts, block = unpacked
    for packed, surface in zip(facts["references"][0]["surfaces"], data.references[0].surfaces, strict=True):
        np.testing.assert_allclose(array(packed["points"], block), surface.points, atol=0.01)
        np.testing.assert_array_equal(array(packed["triangles"], block), surface.triangles)


def test_mesh_and_volume_are_whole(data, unpacked):
    facts, block = unpacked
    np.testing.assert_array_equal(array(facts["mesh"]["tets"], block), data.mesh.tets)
    np.testing.assert_array_equal(array(facts["mesh"]["region"], block), data.mesh.region)
    volume, expected = facts["references"][0]["background"], data.references[0].background.values
    np.testing.assert_array_equal(array(volume["values"], block), expected)


def test_strains_keep_their_value_to_a_fifth_of_a_per_cent(case_result, data, unpacked):
    facts, block = unpacked
    expected = largest_strains(case_result.space, case_result.estimation.displacements[0])
    assert 0.1 < expected.max() < 0.5
    np.testing.assert_allclose(data.mesh.strains, expected, rtol=1e-6)
    packed = array(facts["mesh"]["strain"], block)
    np.testing.assert_allclose(packed, 100.0 * expected, atol=0.5 * STRAIN_STEP + 1e-9)


def test_a_mesh_without_a_fit_has_no_strains(case_result):
    nothing = dataclasses.replace(case_result.estimation, displacements=())
    facts = json.loads(payload(collect(dataclasses.replace(case_result, estimation=nothing))).facts)
    assert facts["mesh"]["strain"]["shape"] == [0]


def test_unobserved_distances_stay_unknown(data, unpacked):
    facts, block = unpacked
    packed, model = facts["later"][0]["model"][0], data.later[0].model[0]
    np.testing.assert_array_equal(array(packed["distance_fitted"], block), model.distance_fitted)


def test_json_in_a_script_cannot_end_it():
    text = script_json({"a": "</script><!--<script>&", "b": "\u2028"})
    assert not set("<>&\u2028") & set(text)
    assert json.loads(text) == {"a": "</script><!--<script>&", "b": "\u2028"}
