"""The palette: its colours stay apart for observers who lack a cone, and stand out on the pages' grounds."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from skimage.color import deltaE_ciede2000, rgb2lab

from simtest.estimators.names import ESTIMATORS
from simtest.pages import style

# Machado, Oliveira and Fernandes (2009), severity 1, linear RGB: what a dichromat sees, as a normal observer sees it.
OBSERVERS = {
    "normal": np.eye(3),
    "protanope": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranope": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}


def linear(colour):
    value = np.array(style.rgb(colour)) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def seen(colour, observer):
    light = np.clip(OBSERVERS[observer] @ linear(colour), 0, 1)
    return rgb2lab(np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055))


def contrast(colour, ground):
    bright, dark = sorted((float(linear(c) @ [0.2126, 0.7152, 0.0722]) for c in (colour, ground)), reverse=True)
    return (bright + 0.05) / (dark + 0.05)


def differences(colours, observer):
    return {
        (a, b): float(deltaE_ciede2000(seen(a, observer), seen(b, observer)))
        for a, b in itertools.combinations(colours, 2)
    }


@pytest.mark.parametrize("observer", OBSERVERS)
def test_every_two_colours_differ_for_every_observer(observer):
    apart = differences([*style.SERIES, style.NEUTRAL], observer)
    assert min(apart.values()) >= style.LEAST_DIFFERENCE, min(apart, key=apart.get)


def test_the_metric_finds_what_it_is_for():
    """Red and green of one lightness: far apart to a normal observer, alike to a deuteranope."""
    pair = ("#C4583C", "#6E8A32")
    assert differences(pair, "normal")[pair] > 40
    assert differences(pair, "deuteranope")[pair] < style.LEAST_DIFFERENCE


@pytest.mark.parametrize("ground", style.GROUNDS)
def test_colours_stand_out_on_light_and_dark(ground):
    told = {colour: contrast(colour, ground) for colour in [*style.SERIES, style.NEUTRAL, *style.FURTHER]}
    assert min(told.values()) >= style.LEAST_CONTRAST, min(told, key=told.get)


def test_the_grounds_are_those_of_the_pages():
    """And contrast is WCAG's: black on white is 21, and a grey of 119 is the lightest that has 4.5 on white."""
    sheet = (Path(style.__file__).parent / "templates" / "base.css.j2").read_text(encoding="utf-8")
    grounds = re.findall(r"--bg: (#[0-9a-f]+);", sheet)[:2]
    assert grounds == ["#fff", style.GROUNDS[1]]
    assert style.rgb(style.GROUNDS[0]) == (255, 255, 255)
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    assert contrast("#777777", "#ffffff") < 4.5 < contrast("#767676", "#ffffff")


def test_every_installed_estimator_of_this_package_has_a_colour_of_its_own():
    assert set(ESTIMATORS.names()) >= set(style.ESTIMATOR_COLOURS)
    assert len({*style.SERIES, *style.FURTHER, style.NEUTRAL}) == len(style.SERIES) + len(style.FURTHER) + 1


def test_other_names_take_further_colours_in_the_order_of_the_alphabet():
    made = style.colours(["zeta", "cone_axis", "alpha"])
    assert made == {"zeta": style.FURTHER[1], "cone_axis": "#166B90", "alpha": style.FURTHER[0]}
    assert style.colours is style.colours
