"""Names, help and search words of settings whose declarations contain none."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from foveasim._core.calls import Words
from foveasim._core.validation import words_and_unit

#: Names of settings in messages: a path before a colon, the name of what must be something, and quoted names with a unit.
NAMES = re.compile(r"^([a-z]\w*(?:\.\w+)*)(?=: )|'([a-z]\w*)'(?= must)|'([a-z]\w*)'")

#: Words by the last name of a setting, or by its last two for a name with several meanings.
WORDS: dict[str, Words] = {
    "a": Words("polynomial", "Coefficients a0, a2, a3, a4 of the polynomial of the lens."),
    "a_um": Words("radius of the fovea"),
    "astigmatism_um": Words(help="Path difference of the astigmatism at the edge of the aperture and of the field."),
    "axis": Words("gaze moves", synonyms="optical axis turn camera gaze"),
    "band_width_nm": Words(synonyms="spectral bandwidth"),
    "bits": Words(
        "bits of the ADC",
        "Number of bits of a code, from 1 to 16.",
        synonyms="adc resolution bit depth quantisation dynamic range",
    ),
    "by_um": Words("displacement", "Displacement of the sites along x and y."),
    "capacitance_f": Words("sense-node capacitance", synonyms="gain,conversion gain,full well"),
    "cds": Words("correlated double sampling", synonyms="cds reset noise"),
    "coma_um": Words(help="Path difference of the coma at the edge of the aperture and of the field."),
    "companding": Words(
        help="Law by which voltages are compressed before the codes: linear, square root, logarithmic or a table.",
        synonyms="gamma log compression hdr",
    ),
    "companding_table": Words(help="Fractions of the code range at equal voltage steps, from 0 to 1."),
    "coupling": Words("inter-pixel capacitance", synonyms="ipc crosstalk"),
    "crosstalk": Words("charge crosstalk", synonyms="diffusion"),
    "dark_activation_ev": Words(
        "activation energy", "Activation energy of the Arrhenius law of the dark current.", synonyms="dark current"
    ),
    "dark_diffusion_fraction": Words(
        "diffusion part",
        "Fraction of the dark current at its reference that is diffusion current.",
        synonyms="dark current",
    ),
    "dark_doubling_k": Words("doubling of dark current", "Temperature rise that doubles the dark current."),
    "dark_e_per_s": Words("dark current", synonyms="dark signal leakage thermal"),
    "dark_law": Words("temperature law", synonyms="dark current"),
    "dark_reference_k": Words(
        "reference temperature", "Temperature at which the dark current is given.", synonyms="dark current"
    ),
    "dbu_um": Words("database unit", synonyms="dbu grid,klayout"),
    "dead_fraction": Words("dead sites", synonyms="defects bad pixels"),
    "device_seed": Words(synonyms="device fixed pattern"),
    "disabled": Words("disabled effects", synonyms="switch off without noise"),
    "distance_m": Words("scene distance", synonyms="object working"),
    "dnl_dn": Words("DNL", "Differential nonlinearity of the ADC: standard deviation of the code transitions."),
    "datasheet": Words(
        "data sheet", "File of a data sheet, whose values replace those of the sensor.", synonyms="emva electronics"
    ),
    "dsnu_e": Words(
        "DSNU", "Standard deviation of dark frames over the sites, as in data sheets.", synonyms="fixed pattern emva"
    ),
    "dsnu_fraction": Words("non-uniformity of dark current", synonyms="fixed pattern,dsnu"),
    "dx_um": Words("displacement along x", "Displacement of all sites along x."),
    "dy_um": Words("displacement along y", "Displacement of all sites along y."),
    "emission": Words(synonyms="relative illumination cos4 vignetting falloff"),
    "exposure_s": Words(
        help="Exposure time: seconds, a fraction such as 1/60, a value such as EV 12, or auto.",
        synonyms="shutter integration time ev brightness",
    ),
    "f_number": Words("f-number", synonyms="aperture iris stop f/ diffraction depth of field"),
    "field_curvature_um": Words(
        help="Path difference of the field curvature at the edge of the aperture and of the field."
    ),
    "field_of_view_deg": Words(synonyms="fov angle of view"),
    "filters": Words("colour filters", synonyms="cfa rgb bayer spectral"),
    "fit": Words("framing", synonyms="fit cover crop size format"),
    "focal_length_mm": Words("focal length", "Focal length of the lens.", synonyms="zoom fov"),
    "focus_distance_m": Words("focus distance", synonyms="defocus blur sharpness"),
    "fovea": Words("filling of the fovea", synonyms="fovea,blind spot,centre hole"),
    "fov_um": Words("field diameter"),
    "fractions": Words("frequencies of the filters"),
    "from_nm": Words("cut-on wavelength"),
    "from_um": Words("moved vertices"),
    "full_well_e": Words("full well", synonyms="saturation capacity dynamic range"),
    "fwhm_nm": Words("full width at half maximum", "Full width of the curve at half of its maximum."),
    "gain_dn_per_e": Words(
        "system gain", "System gain K of the ADC, instead of a capacitance.", synonyms="gain,conversion gain,emva"
    ),
    "gain_fpn_fraction": Words("gain FPN", synonyms="fixed pattern"),
    "gaussian_above_e": Words("exact shot noise up to", synonyms="poisson"),
    "gaze_path": Words(
        help="Gaze of the frames of a video, recorded and edited on the optical image. A single capture has the gaze.",
        synonyms="fixation saccade eye movement record replay",
    ),
    "gaze_range_um": Words(synonyms="fixation saccade eye"),
    "gaze_um": Words(
        "gaze",
        "Point of the image at which the centre of the sensor is.",
        synonyms="fixation saccade eye position pan shift move",
    ),
    "hot_e_per_s": Words(
        "dark current of hot sites",
        "Additional dark current of hot sites, at the reference temperature.",
        synonyms="defects",
    ),
    "hot_fraction": Words(
        "hot sites", "Fraction of sites with additional dark current.", synonyms="defects bad pixels"
    ),
    "illuminance_lux": Words(
        help="Illuminance of the scene, instead of its radiance.", synonyms="light lux brightness photometric"
    ),
    "inl_dn": Words("INL", "Integral nonlinearity of the ADC: deviations at equal code intervals."),
    "inset_um": Words("inset", synonyms="fill factor trench gap"),
    "integration_order": Words("integration order", synonyms="gradient accuracy"),
    "k": Words("polynomial of the angle"),
    "ktc_noise": Words("reset noise (kTC)", synonyms="ktc reset"),
    "lateral_colour": Words("lateral chromatic aberration", synonyms="colour fringe"),
    "layout": Words("layout", synonyms="generator bayer hexagonal log polar foveal grid sensor format"),
    "layout.source": Words("layout source", "Where the figures of the layout come from."),
    "lens": Words("lens model", synonyms="aplanatic thin sine condition"),
    "limit": Words("importance of a square"),
    "line_fpn_fraction": Words(
        "column FPN",
        "Standard deviation of the offsets of readout lines, over the saturation voltage.",
        synonyms="fixed pattern",
    ),
    "log_strength": Words("strength of log companding", "Strength of the logarithmic companding."),
    "luminance_cd_m2": Words(
        help="Luminance of white, instead of the radiance.", synonyms="light brightness display nit photometric"
    ),
    "max_data_rate_gbit_per_s": Words(
        "maximum data rate", "Largest data rate of one lane; requires a readout.", "Gbit/s", "bandwidth"
    ),
    "max_density": Words("maximum fill factor", "Largest fill factor of every window."),
    "max_gap_um2": Words("maximum gap"),
    "max_growth": Words(
        "maximum growth", "Largest ratio of the mean site size of a ring to that of the next inner ring."
    ),
    "max_neighbour_ratio": Words("maximum ratio of neighbours"),
    "max_overlap_um2": Words("maximum overlap"),
    "max_sites": Words("maximum number of photosites"),
    "max_aspect_ratio": Words("maximum aspect ratio"),
    "max_size_um": Words(
        "maximum site size", "Largest size of a site, the square root of its area.", synonyms="largest site,pixel"
    ),
    "max_track_utilisation": Words("maximum track utilisation", synonyms="routing"),
    "min_angle_deg": Words("minimum angle"),
    "min_area_um2": Words("minimum area"),
    "min_density": Words("minimum fill factor", "Smallest fill factor of every window."),
    "min_growth": Words(
        "minimum growth", "Smallest ratio of the mean site size of a ring to that of the next inner ring."
    ),
    "min_hole_um2": Words("minimum hole"),
    "min_size_um": Words(
        "smallest site", synonyms="minimum size,smallest size,pixel size,site size,fovea resolution blind spot"
    ),
    "min_space_um": Words("minimum space", synonyms="gap distance"),
    "min_width_um": Words("minimum width"),
    "mosaic": Words("mosaic", synonyms="bayer rggb quad x-trans cfa colour filter array"),
    "move_um": Words("layout position", synonyms="shift translate"),
    "n_across": Words("diameter in smallest sites"),
    "n_basis": Words("basis images"),
    "n_blades": Words("blades"),
    "n_channels": Words("filters"),
    "n_chords": Words("sides of a circle"),
    "n_columns": Words("columns", "Number of sites per row."),
    "n_fovea": Words("size of the fovea"),
    "n_iterations": Words("iterations"),
    "n_lanes": Words("lanes"),
    "n_layers": Words("metal layers"),
    "n_levels": Words("subdivisions"),
    "n_points": Words("points"),
    "n_rho": Words("rings of the layout"),
    "n_rings": Words("rings"),
    "n_rows": Words("rows", "Number of rows."),
    "n_sectors": Words("sectors", synonyms="angular resolution"),
    "n_sites": Words("photosites", synonyms="number of pixels resolution megapixels count format"),
    "n_spokes": Words("spokes"),
    "n_squares": Words("squares"),
    "n_steps": Words("patches"),
    "n_theta": Words("sites per ring"),
    "n_vanes": Words("vanes", "Number of vanes of the spider."),
    "n_x": Words("columns", "Number of columns.", synonyms="resolution width format"),
    "n_y": Words("rows", "Number of rows; by default as many as columns.", synonyms="resolution height format"),
    "nonlinearity_fraction": Words("nonlinearity"),
    "outlines_um": Words("outlines", "Outlines of the new sites: lists of vertices."),
    "oversample": Words("oversampling"),
    "parameters": Words(help="Parameters of the generator."),
    "peak_radiance_w_m2_sr_nm": Words("radiance of white", synonyms="light brightness"),
    "pedestal_v": Words("black level", synonyms="offset pedestal"),
    "per_um2": Words("per µm²", "Value of a photosite per µm² of its area."),
    "phase_deg": Words("phase"),
    "picture": Words(synonyms="photograph image file scene"),
    "pitch_um": Words("pitch", synonyms="pixel size spacing"),
    "pitch_y_um": Words("pitch of the rows"),
    "pixel_fpn_fraction": Words(
        "pixel FPN",
        "Standard deviation of the offsets of sites, over the saturation voltage.",
        synonyms="fixed pattern dsnu",
    ),
    "preset": Words(
        help="Electronics of a published sensor. Full well and steps of the ADC follow the area of each site.",
        synonyms="electronics template published",
    ),
    "prnu_fraction": Words("PRNU", synonyms="fixed pattern non-uniformity"),
    "psfs": Words(
        "PSFs", "Point spread functions of a lens design, from a file.", synonyms="point spread zemax aberrations"
    ),
    "pupil": Words(synonyms="aperture stop iris psf"),
    "qe": Words("quantum efficiency", synonyms="qe sensitivity"),
    "r_max_um": Words("outer radius", synonyms="size format field"),
    "r_min_um": Words("inner radius", synonyms="blind spot"),
    "radius_um": Words(synonyms="size format field"),
    "read_noise_e": Words("read noise", synonyms="noise,noise floor,snr,dynamic range"),
    "reflectance": Words(help="Reflectance of the white of the scene, with an illuminance."),
    "rows": Words(help="Part of the image, in pixels from the top."),
    "columns": Words(help="Part of the image, in pixels from the left."),
    "rts_e": Words("step of RTS noise", "Difference of the two levels of a site with a random telegraph signal."),
    "rts_fraction": Words(
        "sites with RTS noise", "Fraction of sites with a random telegraph signal (RTS).", synonyms="telegraph"
    ),
    "rules": Words("design rules", synonyms="drc violations"),
    "rules.preset": Words("preset of the rules"),
    "scene.pitch_um": Words("pixel pitch"),
    "rules.min_size_um": Words("minimum site size", "Smallest size of a site, the square root of its area."),
    "rules.grid_um": Words("manufacturing grid"),
    "scene": Words("scene", synonyms="photograph chart cube light"),
    "seed": Words("seed of the noise", "Seed of the temporal noise: equal seeds give equal noise.", synonyms="random"),
    "parameters.seed": Words("seed"),
    "random_channels.seed": Words("seed", "Seed of the random filters."),
    "sensitivity": Words(synonyms="fill factor microlens"),
    "sensor": Words("sensor", synonyms="electronics pixel"),
    "shot_noise": Words(
        help="Draw of the photon shot noise: automatic, exact Poisson numbers, or off.", synonyms="poisson photon snr"
    ),
    "size_um": Words("size of the field", synonyms="format sensor size width height"),
    "snap_um": Words("grid of the vertices"),
    "spherical_um": Words(
        "spherical aberration", "Path difference of the spherical aberration at the edge of the aperture."
    ),
    "temperature_k": Words(help="Temperature of the sensor.", synonyms="cooling dark current"),
    "times_s": Words(
        "times of the frames",
        help="Times of the frames of a video from a directory of pictures (foveasim video).",
        synonyms="video time stamps variable frame rate vfr",
    ),
    "to_nm": Words("cut-off wavelength"),
    "to_um": Words("new positions"),
    "qe.transmission": Words("silicon transmission"),
    "optics.transmission": Words("lens transmission", synonyms="glass t-stop"),
    "trench_um": Words("trench"),
    "twin": Words(
        "twin of a camera",
        "File of a camera's twin, whose values replace those of the sensor.",
        synonyms="measured frames electronics",
    ),
    "unit_um": Words("size of the smallest site"),
    "v_sat_v": Words("saturation voltage", synonyms="full scale swing"),
    "wavelength_nm": Words(synonyms="colour spectrum"),
    "zernike": Words("Zernike aberrations", synonyms="wavefront defocus"),
    "seidel": Words("Seidel aberrations", synonyms="wavefront coma astigmatism"),
}


def words_of(key: str, node: Mapping[str, Any]) -> Words:
    """Return the words of the setting with a path: those of its declaration, or of its name."""
    if "words" in node:
        return Words(**node["words"])
    names = [name for name in key.split(".") if not name.isdecimal()]
    return WORDS.get(".".join(names[-2:])) or WORDS.get(names[-1]) or Words()


def worded(text: str) -> str:
    """Return a message with the words of the controls: ``Exposure (exposure_s): must be ...``."""

    def with_words(found: re.Match[str]) -> str:
        key = found[1] or found[2] or found[3]
        words, unit = words_and_unit(key.rpartition(".")[2])
        label = words_of(key, {}).label or (words if unit else "")
        return found[0] if label in ("", key) or (found[3] and not unit) else f"{label[0].upper()}{label[1:]} ({key})"

    return NAMES.sub(with_words, text)
