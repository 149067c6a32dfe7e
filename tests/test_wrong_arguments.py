"""Wrong numbers, shapes and types as arguments of all public functions: rejected, or allowed for a reason."""

from __future__ import annotations

import inspect
import signal
import warnings
from functools import partial

import numpy as np
import pytest
from reference.public_calls import annotations_of, example, make_objects, public_calls

import foveasim as fs
from foveasim.errors import FoveasimError

#: Seconds after which a call counts as endless.
LIMIT_S = 20
HUGE = 2**70


def values_for(kind, plausible):
    """Return the invalid numbers for an annotation."""
    text = str(kind).lower()
    if "float" not in text and "int" not in text and "ndarray" not in text and "array" not in text:
        return {}
    if isinstance(plausible, np.ndarray):
        return {"inf": np.full(plausible.shape, np.inf), "NaN": np.full(plausible.shape, np.nan)}
    if isinstance(plausible, tuple):
        return {"inf": tuple(np.inf for _ in plausible), "NaN": tuple(np.nan for _ in plausible)}
    return {"huge": HUGE} if "float" not in text else {"inf": np.inf, "NaN": np.nan}


#: One of these replaces each argument: of wrong type, shape, sign or size for most.
WRONG = {
    "infinity": lambda: np.inf, "NaN": lambda: np.nan, "huge": lambda: HUGE, "negative": lambda: -1, "zero": lambda: 0,
    "fraction": lambda: 1.5, "text": lambda: "x", "None": lambda: None, "no items": list, "three": lambda: np.ones(3),
    "two by two": lambda: np.ones((2, 2)), "no numbers": lambda: np.empty(0), "object": object, "mapping": dict,
    "tuple": lambda: (1.0, 2.0, 3.0),
}  # fmt: skip


def working_calls():
    """Yield calls that work with plausible arguments: name, call, these arguments, and the values of all parameters."""
    objects = make_objects()
    for name, call, owner in public_calls():
        bound = next((each for each in objects if owner is not None and isinstance(each, owner)), None)
        if owner is not None and bound is None:
            continue
        parameters = list(inspect.signature(call).parameters.values())[0 if owner is None else 1 :]
        parameters = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
        kinds = annotations_of(call)
        plausible = {p.name: (kinds.get(p.name), example(kinds.get(p.name), objects)) for p in parameters}
        usual = {p.name: plausible[p.name][1] for p in parameters if p.default is p.empty}
        with_object = call if owner is None else partial(call, bound)
        if outcome(with_object, usual) == "accepted":
            yield name, with_object, usual, plausible


def outcomes():
    """Yield calls, parameters and invalid numbers with their outcomes."""
    for name, call, usual, plausible in working_calls():
        for parameter, (kind, value) in plausible.items():
            for what, wrong in values_for(kind, value).items():
                yield name, parameter, what, outcome(call, usual | {parameter: wrong})


def outcome(call, values):
    def stop(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(LIMIT_S)
    try:
        call(**values)
    except FoveasimError:
        return "rejected"
    except Exception as error:  # noqa: BLE001 -- compared
        return repr(error)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    return "accepted"


#: Results: their numbers come from a simulation, and contain NaN and infinity where there is no value.
RESULTS = {
    "AliasingSpectrum", "BarElement", "Budget", "Calibration", "Change", "Changes", "Comparison", "Cube", "Deviation",
    "EccentricityTable", "EdgeMtf", "EmvaIntervals", "FieldModes", "FlowBound", "Found", "Mesh", "Outlines", "PartReport", "PictureComparison", "Plan",
    "PointSpread", "Ramp", "Rates", "Recording", "Report", "RuleResult", "SamplingSpectrum", "Shot", "SiteColours", "SiteEstimates",
    "EventPixelFit",
    "SiteGraph", "SitePixels", "SiteSignals", "Sites", "SnrTable", "Solution", "Stock", "Summary", "TiledCapture", "Violation",
    "Estimate", "Twin", "WrittenLayout",
}  # fmt: skip
#: Functions of numbers: those of NaN are NaN.
OF_NUMBERS = {
    "Annulus.__call__", "Seidel.wavefront_um", "Zernike.wavefront_um", "circular_otf", "decode_srgb", "electrons_to_volts",
    "encode_srgb", "m_from_mm", "m_from_nm", "m_from_um", "median_interval", "per_mm_from_per_um", "per_um_from_per_mm",
    "photon_energy_j", "um_from_m", "um_from_nm", "volts_to_electrons", "w_from_w_m2_um2", "zernike",
}  # fmt: skip
#: Effects: steps of a chain, which checks charges at its beginning.
OF_EFFECTS = {"apply", "cumulative", "during", "linearise", "moments", "select"}
#: Parameters of any size: seeds and numbers of frames, caches and parts (of no more than there is), limits, and sites that a
#: layout may have.
OF_ANY_SIZE = {
    "above", "ahead", "at_least", "at_most", "batch", "device_seed", "first_frame", "frame", "low", "max_sites", "n_grids",
    "n_lanes", "n_sites", "seed", "site", "tile_sites",
}  # fmt: skip
#: Further parameters.
ALLOWED = {
    ("Optics", "focus_distance_m"): "focused at infinity",
    ("Optics", "exit_pupil_mm"): "telecentric",
    ("Optics.cut_off_um", "distance_m"): "a scene at infinity",
    ("Optics.defocus_um", "distance_m"): "a scene at infinity",
    ("Optics.irradiance_per_radiance", "distance_m"): "a scene at infinity",
    ("Optics.magnification", "distance_m"): "a scene at infinity",
    ("Optics.working_f_number", "distance_m"): "a scene at infinity",
    ("OpticalFormat", "size_um"): "an entry of a table",
    ("Routing.n_tracks", "strip_um"): "tracks of an unlimited strip",
    ("Rule", "rounding"): "a rule without tolerance, or without limit",
    ("Sensor.are_saturated", "code"): "comparisons",
    ("Sensor.are_saturated", "electrons"): "comparisons",
    ("Sensor.invert_collection", "charge_e"): "saturated sites have an infinite charge",
    ("Sensor.invert_collection", "noise_e2"): "saturated sites have an infinite variance",
}


def is_allowed(name, parameter):
    path = name.split(".")
    short = ".".join(path[-2:]) if path[-2][0].isupper() or path[-2].startswith("_P") else path[-1]
    return (
        path[-1] in RESULTS
        or short in OF_NUMBERS
        or (".effects." in name and path[-1] in OF_EFFECTS)
        or parameter in OF_ANY_SIZE
        or (short, parameter) in ALLOWED
    )


@pytest.mark.slow
def test_infinite_numbers_are_rejected_or_allowed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = list(outcomes())
    wrong = [each for each in found if each[3] != "rejected" and not (each[3] == "accepted" and is_allowed(*each[:2]))]

    assert len({name for name, *_ in found}) > 180
    assert sum(each[3] == "rejected" for each in found) > 500
    assert wrong == []


def test_wrong_arguments_have_clear_errors(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    n_calls, found, changed = 0, [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, call, usual, plausible in working_calls():
            n_calls += 1
            for parameter in plausible:
                for what, make in WRONG.items():
                    value = make()
                    found.append((name, parameter, what, outcome(call, usual | {parameter: value})))
                    if isinstance(value, np.ndarray) and not value.flags.writeable:
                        changed.append((name, parameter))

    assert n_calls > 280
    assert sum(each[3] == "rejected" for each in found) > 11_000
    assert [each for each in found if each[3] not in ("accepted", "rejected")] == []
    assert changed == []


LAYOUT = fs.layout.grid(4, 4, 3.0)
SENSOR = fs.Sensor(LAYOUT, capacitance_f=2e-15, bits=10)
FLAT = np.full(16, 100.0)


@pytest.mark.parametrize("value", [np.inf, np.nan])
@pytest.mark.parametrize(
    "call",
    [
        lambda value: SENSOR.predict(np.full(16, value)),
        lambda value: SENSOR.collect(np.full(16, value), seed=0),
        lambda value: SENSOR.collect(FLAT, seed=0, exposure_s=value),
        lambda value: SENSOR.expose(np.full(16, value), 0.01, seed=0),
        lambda value: SENSOR.read(np.full(16, value), seed=0),
        lambda value: fs.sensor.signal_to_noise(SENSOR, np.full(16, value), np.zeros(16)),
        lambda value: fs.sensor.noise_budget(SENSOR, np.full(16, value), 0.01),
        lambda value: fs.metrics.draw_frames(SENSOR, np.full(16, value), seed=0),
        lambda value: fs.metrics.draw_frames(SENSOR, FLAT, seed=0, exposure_s=value),
        lambda value: fs.metrics.photon_transfer(SENSOR, expected_e=[value], seed=0),
        lambda value: SENSOR.calibrate(exposure_s=value, flat_e=FLAT, n_frames=4, seed=0),
        lambda value: SENSOR.calibrate(exposure_s=0.01, flat_e=FLAT, n_frames=4, seed=0).correct(np.full(16, value)),
        lambda value: fs.distortion.read_calibration("a.yaml", pixel_um=3.0, focal_um=value),
        lambda value: LAYOUT.plot(figure_inches=value),
        lambda value: fs.sensor.Footprints(np.full(16, value), LAYOUT),
        lambda value: fs.modes.Shutter(LAYOUT.with_columns(readout_order=np.full(16, value)), frame_s=0.01, line_s=1e-5),
        lambda value: fs.reconstruct.fill_channels(LAYOUT, np.full(16, value), np.zeros(16, int), 1),
        lambda value: fs.reconstruct.fill_channels(LAYOUT, FLAT, np.full(16, value), 1),
    ],
)  # fmt: skip
def test_infinite_values_are_rejected(call, value):
    with pytest.raises(FoveasimError, match="must be"):
        call(value)


@pytest.mark.parametrize(
    "call",
    [
        lambda: fs.metrics.draw_frames(SENSOR, FLAT, n_frames=HUGE, seed=0),
        lambda: fs.metrics.photon_transfer(SENSOR, expected_e=[9.0], n_frames=HUGE, seed=0),
        lambda: SENSOR.calibrate(exposure_s=0.01, flat_e=FLAT, n_frames=HUGE, seed=0),
        lambda: fs.optics.zernike(HUGE, 0, 0.0, 0.0),
    ],
)
def test_huge_counts_are_rejected_before_work(call):
    with pytest.raises(FoveasimError, match="must be <= "):
        call()
