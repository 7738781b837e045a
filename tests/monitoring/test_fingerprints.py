"""Fingerprints of rows: the same whatever the order and rounding, others where a value or a name differs."""

from dataclasses import replace

import numpy as np
from simulated import measure, small_arm

from fg_calib import Pairing, Table
from fg_calib.measurements import form_pairs
from fg_calib.monitoring.prior_information import MAX_FINGERPRINTS, counted_before, fingerprints

ARM = small_arm()


def poses(seed=0, n=40):
    rng = np.random.default_rng(seed)
    return measure(ARM, n, rng)


def test_rows_have_the_same_fingerprints_in_any_order_and_but_for_rounding():
    m = poses()
    marks = fingerprints([Table(m, "pose")])
    assert len(marks) == 40
    assert all(len(mark) == 12 for mark in marks)
    assert fingerprints([Table(m.select(np.arange(40)[::-1]), "pose")]) == marks
    assert fingerprints([Table(replace(m, position=m.position * 1000 / 1000), "pose")]) == marks


def test_other_values_readings_and_pairs_have_other_fingerprints():
    m = poses()
    marks = set(fingerprints([Table(m, "pose")]))
    for other in (replace(m, position=m.position + 1e-9), replace(m, readings=m.readings + 1e-9), poses(1)):
        assert not marks & set(fingerprints([Table(other, "pose")]))
    pairs = replace(m, pairs=form_pairs(m, Pairing("chain")), position=None, rotation=None)
    moved = replace(pairs, pairs=replace(pairs.pairs, distance=pairs.pairs.distance + 1e-9))
    of_pairs = set(fingerprints([Table(pairs, "distance")]))
    assert len(of_pairs) == 39
    assert not of_pairs & set(fingerprints([Table(moved, "distance")]))


def test_a_table_was_counted_before_if_half_of_its_rows_were():
    known = fingerprints([Table(poses(), "pose")])
    mixed = poses().select(np.arange(19)), poses()
    assert counted_before(Table(mixed[0], "pose"), known)
    assert counted_before(Table(mixed[1], "pose"), known[:20])
    assert not counted_before(Table(mixed[1], "pose"), known[:19])


def test_test_rows_have_none_and_many_rows_have_a_thousand():
    m = poses(n=1200)
    assert len(fingerprints([Table(m, "pose")])) == MAX_FINGERPRINTS
    assert fingerprints([Table(replace(m, test=np.ones(1200, dtype=bool)), "pose")]) == ()
