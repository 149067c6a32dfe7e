"""
Optics as a differentiable function of scene, spectral weights and aberrations.

Maps are those of :meth:`foveasim.Optics.weighted_maps`, on the device and with the precision of the pictures. The transforms
are those of torch, so that derivatives of any order exist; only the transfer functions of a lens without variables, and the
padding of pictures without derivatives, come from the kernels of the simulator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
import scipy.fft
import torch
from torch import Tensor, nn

from foveasim._core.names import possible_names
from foveasim._core.validation import Floats, Ints
from foveasim._io.mapped_files import in_memory
from foveasim.errors import ParameterError
from foveasim.fields import Grid, SceneLike
from foveasim.learn._tensors import Constants, Parts, check_tensor, constant, in_parts, is_array
from foveasim.optics import Optics, PupilImage, Seidel, Zernike, zernike
from foveasim.optics._aperture import PUPIL_POINTS, Aperture, overlaps
from foveasim.optics._imaging import PatchExtent
from foveasim.units import um_from_nm

__all__ = ["VARIABLES", "Imaging", "Origin"]

#: Position of the first row of pictures, as in matplotlib.
Origin = Literal["lower", "upper"]

#: Variables of a lens.
VARIABLES = ("zernike", "seidel", "defocus", "pupil")
#: Isoplanatic patches along each side of the picture by default.
PATCHES = 5
#: Number of cells, of all padded basis images, that a processor transforms at once: they stay in its cache.
MAX_PART = 2**21
#: Number of cells, of all padded basis images, that all threads transform at the same time: some 1 GiB in single precision.
MAX_CELLS = 2**26
#: Largest number of runs of pixels that are copied with derivatives; others are looked up.
MAX_RUNS = 8
#: Coefficients of Seidel aberrations, in the order of the tensor.
SEIDEL_NAMES = ("spherical_um", "coma_um", "astigmatism_um", "field_curvature_um")
#: Largest number of aliases per side of a lens with variables; more would take minutes.
MAX_DIRECT_ALIASES = 2


class Imaging(nn.Module):
    """
    Power maps of scenes behind a lens.

    Parameters
    ----------
    optics : Optics
        Initial lens. Lateral chromatic aberration is not supported.
    scene : Scene
        Geometry and spectrum: distance, pixel pitch, wavelengths. Its basis images are the default of :meth:`forward`.
    wrt : iterable of {"zernike", "seidel", "defocus", "pupil"}
        Variables of the lens.

    Attributes
    ----------
    zernike : Parameter (n_coefficient,), µm
        Coefficients of ``optics.zernike``, in the order of its indices.
    seidel : Parameter (4,), µm
        Spherical aberration, coma, astigmatism and field curvature of ``optics.seidel``.
    defocus : Parameter (), µm
        Path difference at the edge of the aperture, in addition to that of the focus distance.
    pupil : Parameter (n, n)
        Amplitude transmission of uniform squares over the square around the aperture, bottom row first: of ``optics.pupil``,
        a :class:`foveasim.optics.PupilImage`.
    grid : Grid
        Grid of the maps.

    Raises
    ------
    ParameterError
        When a variable is unknown or absent from the initial lens, or the cells are too coarse.

    Notes
    -----
    Where variable aberrations vary over the field, isoplanatic patches replace modes: ``optics.field_patches``, by default 5.
    Padding, and the sampling of the aperture, are those of the initial lens: start with aberrations of the size that you
    expect, or set ``padding_cells``. Variations of a lens whose initial OTF is that of the clear circle use the sampled
    aperture, whose OTF is accurate to 7e-4.
    """

    zernike: nn.Parameter
    seidel: nn.Parameter
    defocus: nn.Parameter
    pupil: nn.Parameter

    def __init__(self, optics: Optics, scene: SceneLike, wrt: Iterable[str] = ()) -> None:
        super().__init__()
        if optics.lateral_colour is not None:
            raise ParameterError("optics", "must have no lateral chromatic aberration for gradients", optics)
        if getattr(scene, "depth_m", None) is not None:
            raise ParameterError(
                "scene", "must be a plane for PyTorch, got one with depth; its layers have no gradients", scene
            )
        self.wrt: tuple[str, ...] = _check_variables("wrt", wrt, VARIABLES)
        if self.wrt and optics.psfs is not None:
            raise ParameterError("wrt", "must be empty for a lens with 'psfs', whose aberrations are fixed", self.wrt)
        initial = optics.resolve_oversample(scene)
        self._optics = replace(initial, precision="double")
        if self.wrt and initial.is_varying and initial.field_patches is None:
            self._optics = replace(self._optics, field_patches=PATCHES)
        if self.wrt and self._optics.zernike is None and self._optics.seidel is None and not self._optics.pupil:
            # A sampled aperture without aberrations.
            self._optics = replace(self._optics, zernike=Zernike(coefficients={4: 0.0}))
        self._scene = scene
        aperture = self._optics.aperture(scene)
        # Of variables only, which lenses with sampled PSFs do not have.
        self._aperture: Any = aperture if isinstance(aperture, Aperture) else None
        self._imaging, self._tables_at = self._optics.imaging(scene, np.eye(scene.wavelength_nm.size))
        # Weights of the modes over the field, the mean first.
        weights = [np.ones(scene.basis.shape[1:]), *(each.at_pixels() for each in self._imaging.field_weights)]
        self._n_modes = len(weights)
        self._constants = Constants(field_weights=np.stack(weights), irradiance=self._imaging.irradiance_w_m2)
        self.grid: Grid = self._optics.image_grids(scene)[0][0]
        self._n_patches = self._optics.n_patches
        for name in self.wrt:
            setattr(self, name, nn.Parameter(constant(self._start(name))))
        self._computed: dict[Any, Any] = {}
        self._patches = self._extents()
        self._cells = [_slices(self._imaging.patch_cells(*each[1:])) for each in self._patches]
        self._sources = [
            _Padding(rows, columns, self._imaging.patch_window(rows, columns), scene.basis.shape[1])
            for _, rows, columns in self._patches
        ]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("_imaging", "_tables_at")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._imaging, self._tables_at = self._optics.imaging(self._scene, np.eye(self._scene.wavelength_nm.size))

    @property
    def has_patches(self) -> bool:
        """Whether the picture is imaged in isoplanatic patches."""
        return self._n_patches != (1, 1)

    @property
    def is_invariant(self) -> bool:
        """Whether relative illumination and PSF are equal everywhere."""
        if self.has_patches or self._n_modes > 1:
            return False
        _, rows, columns = self._patches[0]
        return bool(np.ptp(self._imaging.patch_window(rows, columns)) == 0.0)

    def __repr__(self) -> str:
        return f"Imaging({self._optics!r}, variables: {', '.join(self.wrt) or 'none'})"

    def _once(self, name: str, sampling: float, field_um: tuple[float, float], compute: Callable[[], Any]) -> Any:
        """Return constants of the aperture, which are computed once."""
        key = name, sampling, field_um
        if key not in self._computed:
            self._computed[key] = compute()
        return self._computed[key]

    def _start(self, name: str) -> Any:
        """Return the initial values of a variable."""
        lens = self._optics
        if name == "defocus":
            return 0.0
        if name == "zernike":
            if lens.zernike is None:
                raise ParameterError(
                    "wrt", "must not contain 'zernike' without optics.zernike", hint="set Zernike(...)"
                )
            per_wave = [list(lens.zernike.coefficients_um(float(w)).values()) for w in self._scene.wavelength_nm]
            if np.ptp(per_wave, axis=0).max() > 0.0:
                raise ParameterError(
                    "wrt",
                    "must not contain 'zernike' with coefficients that depend on the wavelength",
                    hint="use unit='um'",
                )
            return per_wave[0]
        if name == "seidel":
            if lens.seidel is None:
                raise ParameterError("wrt", "must not contain 'seidel' without optics.seidel", hint="set Seidel(...)")
            return [getattr(lens.seidel, key) for key in SEIDEL_NAMES]
        images = lens.pupil if isinstance(lens.pupil, tuple) else (lens.pupil,)
        if len(images) != 1 or not isinstance(images[0], PupilImage) or images[0].wavefront_um is not None:
            raise ParameterError(
                "wrt", "must not contain 'pupil' unless optics.pupil is a PupilImage without wavefront", lens.pupil
            )
        return np.asarray(images[0].picture)[::-1]

    def optics(self) -> Optics:
        """
        Return the lens with the current values of its variables.

        Raises
        ------
        ParameterError
            When a value is out of range, such as a transmission above 1.
        """
        values = {name: getattr(self, name).detach().double().cpu().numpy() for name in self.wrt}
        lens = self._optics
        if "zernike" in values or "defocus" in values:
            start = lens.zernike or Zernike(coefficients={4: 0.0})
            wave_nm = float(self._scene.wavelength_nm[0])
            found = start.coefficients_um(wave_nm)
            if "zernike" in values:
                found = dict(zip(found, values["zernike"].tolist(), strict=True))
            # r² is sqrt(3) / 6 times the polynomial of defocus, apart from a constant.
            found[2, 0] = found.get((2, 0), 0.0) + float(values.get("defocus", 0.0)) / (2.0 * math.sqrt(3.0))
            lens = replace(
                lens, zernike=Zernike(coefficients={_osa(n, m): c for (n, m), c in found.items()}, index="osa")
            )
        if "seidel" in values:
            assert lens.seidel is not None
            lens = replace(
                lens, seidel=replace(lens.seidel, **dict(zip(SEIDEL_NAMES, values["seidel"].tolist(), strict=True)))
            )
        if "pupil" in values:
            lens = replace(lens, pupil=PupilImage(values["pupil"][::-1]))
        return lens

    def forward(self, weights: Tensor | None = None, basis: Tensor | None = None) -> Tensor:
        """
        Compute weighted sums of power maps over wavelength.

        Parameters
        ----------
        weights : (n_output, n_wavelength) tensor, optional
            By default one output per wavelength: W/m² per band.
        basis : (..., n_basis, n_y, n_x) tensor, optional
            Basis images of scenes; by default those of the scene.

        Returns
        -------
        maps : (..., n_output, k n_y, k n_x) tensor
            Sums over the basis images, with ``optics.oversample`` k; cell means, bottom row first. On the device and with the
            dtype of the basis images; float64 for those of the scene.
        """
        if basis is None:
            basis = torch.from_numpy(np.array(in_memory(self._scene.basis), np.float64))
            basis = basis if weights is None else basis.to(weights.device)
        return self.filtered(basis, self.transfer(weights))

    def transfer(self, weights: Tensor | None = None) -> list[Tensor]:
        """
        Compute the transfer functions from basis images to weighted sums of maps.

        Parameters
        ----------
        weights : (n_output, n_wavelength) tensor, optional
            As for :meth:`forward`.

        Returns
        -------
        list of (n_output, n_image, n_row, n_column) complex tensors
            For :meth:`filtered`; one for each isoplanatic patch. Images are the pairs of a basis image and a mode of the field.
        """
        n_waves = self._scene.wavelength_nm.size
        if weights is None:
            weights = torch.eye(n_waves, dtype=torch.float64)
        weights = check_tensor("weights", weights, (None, n_waves), ", one column per wavelength", any_device=True)
        per_image = weights.tile(1, self._n_modes)[:, None, :] * self._constants.get("irradiance", weights)
        found = []
        for number, (field_um, rows, columns) in enumerate(self._patches):
            factors, transmittance = self._factors(number, field_um, rows.cells.size, columns.cells.size, weights)
            found.append(torch.einsum("cbk,kyx->cbyx", (per_image * transmittance).to(factors.dtype), factors))
        return found

    def split(self, scenes: Tensor, n_shifts: int = 1) -> Parts:
        """Return the parts of a batch that are imaged at once, with some shifts each."""
        if scenes.device.type != "cpu" or torch.compiler.is_compiling():
            return Parts()
        n_cells = sum(rows.cells.size * columns.cells.size for _, rows, columns in self._patches)
        n_cells *= n_shifts * self._scene.basis.shape[0] * self._n_modes * self._imaging.oversample**2
        n, n_scenes = max(1, MAX_PART // max(1, n_cells)), scenes.shape[0]
        parts = [slice(k, min(k + n, n_scenes)) for k in range(0, n_scenes, n)]
        return Parts(parts, max(1, MAX_CELLS // (n * n_cells))) if parts and n_cells else Parts()

    def filtered(self, basis: Tensor, transfer: Sequence[Tensor]) -> Tensor:
        """
        Compute maps with transfer functions.

        Parameters
        ----------
        basis : (..., n_basis, n_y, n_x) tensor
            Basis images of scenes.
        transfer : list of tensors
            From :meth:`transfer`.

        Returns
        -------
        maps : (..., n_output, k n_y, k n_x) tensor
            As for :meth:`forward`.
        """
        shape = self._scene.basis.shape
        if not isinstance(basis, Tensor) or basis.ndim < 3:
            check_tensor("basis", basis, shape, any_device=True)
        flat = basis.reshape(-1, *basis.shape[-3:])
        check_tensor("basis", flat, (None, *shape), ", as the scene", any_device=True)
        maps = in_parts(lambda part: torch.stack(list(self.outputs(part, transfer)), dim=1), self.split(flat), flat)
        return maps.reshape(*basis.shape[:-3], *maps.shape[1:])

    def outputs(
        self,
        basis: Tensor,
        transfer: Sequence[Tensor],
        shift: Tensor | None = None,
        *,
        origin: Origin = "lower",
        is_padded: bool = False,
    ) -> Iterator[Tensor]:
        """
        Compute the maps of one output after the other.

        They stay in the cache of the processor.

        Parameters
        ----------
        basis : (n_scene, n_basis, n_y, n_x) tensor
        transfer : list of tensors
            From :meth:`transfer`.
        shift : (n_scene, n_shift, 2) tensor, optional
            Displacements (x, y) of the point of each map at which the position before was, in cells: its spectrum is multiplied
            by a phase. Maps continue beyond their edges as the padding, and periodically beyond it.
        origin : {"lower", "upper"}
            Position of the first row of the basis images; maps have the bottom row first.
        is_padded : bool
            Whether maps keep the columns of their padding: see :attr:`padded_columns`. Not for isoplanatic patches.

        Yields
        ------
        (n_scene * n_shift, k n_y, n_column) tensor
        """
        if not self.has_patches:
            of_rows, of_columns = self._cells[0][1]
            for found in self._outputs(self._spectra(basis, 0, shift, origin), 0, transfer[0], of_rows):
                yield found if is_padded else found[..., of_columns]
            return
        total: list[Tensor] = []
        n_y, n_x = self.grid.shape
        for number, ((to_y, to_x), (from_y, from_x)) in enumerate(self._cells):
            around = to_x.start, n_x - to_x.stop, to_y.start, n_y - to_y.stop
            spectra = self._spectra(basis, number, shift, origin)
            found_of = self._outputs(spectra, number, transfer[number], from_y)
            maps = [nn.functional.pad(found[..., from_x], around) for found in found_of]
            total = [a + b for a, b in zip(total, maps, strict=True)] if total else maps
        yield from total

    @property
    def padded_columns(self) -> tuple[int, int]:
        """Number of columns of a padded map, and the first one of the map."""
        return self._imaging.oversample * self._patches[0][2].cells.size, self._cells[0][1][1].start

    def _extents(self) -> list[tuple[tuple[float, float], PatchExtent, PatchExtent]]:
        """Return field position and extents of all patches, or of the padded picture."""
        if self._n_patches != (1, 1):
            return self._imaging.patches(self._n_patches)

        def complete(sources: Ints, n: int) -> PatchExtent:
            cells = np.arange(sources.size) - (sources.size - n) // 2
            return PatchExtent(np.maximum(sources, 0), (sources >= 0).astype(float), slice(0, sources.size), cells)

        rows, columns = (
            complete(sources, n) for sources, n in zip(self._imaging.sources(), self._imaging.grid.shape, strict=True)
        )
        return [((0.0, 0.0), rows, columns)]

    def _outputs(self, spectra: Tensor, number: int, transfer: Tensor, of_rows: slice) -> Iterator[Tensor]:
        """Yield rows of the maps (n_scene * n_shift, n_row, k n_column) of each output."""
        n_columns = self._imaging.oversample * self._patches[number][2].cells.size
        is_real = not transfer.is_complex()
        if is_real:  # interleaved, once for real and imaginary parts
            spectra = torch.view_as_real(spectra).flatten(-2)
        for of_output in transfer.to(device=spectra.device, dtype=spectra.dtype):
            total = spectra[:, 0] * of_output[0]
            for image in range(1, of_output.shape[0]):
                total.addcmul_(spectra[:, image], of_output[image])
            if is_real:
                total = torch.view_as_complex(total.unflatten(-1, (-1, 2)))
            # Rows that are not needed are not transformed along x.
            yield torch.fft.irfft(torch.fft.ifft(total, dim=-2)[..., of_rows, :], n_columns)

    def _spectra(self, basis: Tensor, number: int, shift: Tensor | None, origin: Origin) -> Tensor:
        """Return the spectra (n_scene * n_shift, n_image, ...) of the padded images."""
        # Each pair of an image and a mode is an image.
        if self._n_modes > 1:
            weights = self._constants.get("field_weights", basis)
            basis = (basis[:, :, None] * (weights if origin == "lower" else weights.flip(-2))).flatten(1, 2)
        rows, columns = self._patches[number][1:]
        k, (n_y, n_x) = self._imaging.oversample, (rows.cells.size, columns.cells.size)
        get = partial(self._constants.get, like=basis)
        padded = self._sources[number].apply(basis, origin)
        if k == 1:
            spectra = torch.fft.rfft2(padded)
        else:
            # Points at the centres of source pixels have a periodic spectrum; see foveasim.optics._transform.
            spectra = torch.fft.fft2(padded)
            fine_y = get(f"fine y {number}", compute=lambda: np.arange(k * n_y) % n_y)
            spectra = spectra[
                ..., fine_y[:, None], get(f"fine x {number}", compute=lambda: np.arange(k * n_x // 2 + 1) % n_x)
            ]
            spectra = spectra * get(f"phase {number}", compute=lambda: self._phase(n_y, n_x))
        if shift is not None:
            cycles_x = get(f"cycles x {number}", compute=lambda: self._cycles(n_y, n_x)[0])
            cycles_y = get(f"cycles y {number}", compute=lambda: self._cycles(n_y, n_x)[1])
            along_x, along_y = _shifted(cycles_x, shift[..., 0]), _shifted(cycles_y, shift[..., 1])
            spectra = spectra[:, None] * along_x[:, :, None, None, :] * along_y[:, :, None, :, None]
            spectra = spectra.flatten(0, 1)
        return spectra

    def _phase(self, n_y: int, n_x: int) -> Any:
        """Return the factors of spectra of points on fine cells."""
        k, (cycles_x, cycles_y) = self._imaging.oversample, self._cycles(n_y, n_x)
        shift = -math.pi * (k - 1)
        return k * k * np.exp(1j * shift * cycles_y)[:, np.newaxis] * np.exp(1j * shift * cycles_x)

    def _cycles(self, n_y: int, n_x: int) -> tuple[Floats, Floats]:
        """Return the frequencies along x and y of the fine cells, in cycles per cell."""
        k = self._imaging.oversample
        cycles_y = scipy.fft.fftfreq(k * n_y)
        return scipy.fft.rfftfreq(k * n_x), np.where((cycles_y == -0.5) & (k % 2 == 0), 0.5, cycles_y)

    # -- transfer functions -------------------------------------------------------------------------------------------

    def _factors(
        self, number: int, field_um: tuple[float, float], n_y: int, n_x: int, like: Tensor
    ) -> tuple[Tensor, Tensor]:
        """
        Return the transfer function of each wavelength, and the change of its transmittance.

        (n_wavelength, k n_y, k n_x // 2 + 1) and (n_wavelength,).
        """
        if self.wrt:
            tables, transmittance, per_step = self._otf_tables(field_um)
            return self._sample_tables(tables, per_step, n_y, n_x), transmittance
        factors = self._constants.get(f"factors {number}", like, lambda: self._fixed_factors(field_um, n_y, n_x))
        return factors, like.new_ones(factors.shape[0])

    def _fixed_factors(self, field_um: tuple[float, float], n_y: int, n_x: int) -> Any:
        """Return the transfer functions of a lens without variables."""
        k, n_waves = self._imaging.oversample, self._imaging.irradiance_w_m2.shape[1]
        transform = self._imaging.transform(np.arange(n_y), np.arange(n_x), (n_y, n_x))
        tables_at, full = self._tables_at(field_um), np.zeros((n_waves, k * n_y, k * n_x // 2 + 1), complex)
        for wave, weight in enumerate(np.eye(n_waves)):
            columns = transform.complete(transform.factor(*tables_at(weight)))
            of_row = np.arange(k * n_y)
            if columns.shape[1] < k * n_y:  # even along y
                of_row = np.minimum(of_row, k * n_y - of_row)
            full[wave, :, : columns.shape[0]] = columns[:, of_row].T
        return full

    def _otf_tables(self, field_um: tuple[float, float]) -> tuple[Tensor, Tensor, float]:
        """Return OTF tables over (f_y, f_x), relative transmittances, and their step."""
        waves_nm = self._scene.wavelength_nm
        near_um = um_from_nm(waves_nm) * self._optics.working_f_number(self._scene.distance_m)
        n_across = [self._aperture.n_across(float(w), field_um) for w in waves_nm]
        per_step = float((np.array(n_across) * near_um).max())
        n_lags = math.ceil(per_step / float(near_um.min()))
        tables, transmittances = [], []
        for wave_nm, lambda_n_um in zip(waves_nm, near_um, strict=True):
            table, transmittance = self._otf(float(wave_nm), per_step / float(lambda_n_um), n_lags, field_um)
            tables.append(table)
            transmittances.append(transmittance)
        return torch.stack(tables), torch.stack(transmittances), per_step

    def _otf(
        self, wave_nm: float, n_across: float, n_lags: int, field_um: tuple[float, float]
    ) -> tuple[Tensor, Tensor]:
        """Return the OTF at integer lags, and the relative transmittance."""
        like = getattr(self, self.wrt[0])
        samples, at, power = self._once(
            "samples", wave_nm, field_um, lambda: self._aperture.samples(wave_nm, n_across, field_um)
        )
        amplitude = self._constants.get(f"samples {wave_nm} {field_um}", like, lambda: samples)
        change = like.new_ones(())
        if "pupil" in self.wrt:
            amplitude, change = self._pupil_amplitude(wave_nm, n_across, samples, at, field_um)
        path_um = self._path_change_um(at, field_um)
        if path_um is not None:
            phase = (2.0 * math.pi / float(um_from_nm(wave_nm))) * path_um
            amplitude = amplitude * torch.complex(torch.cos(phase), torch.sin(phase))
        n = samples.shape[0]
        size = scipy.fft.next_fast_len(2 * n)
        wave = torch.fft.fft2(amplitude, (size, size))
        otf = torch.fft.fft2(wave.real**2 + wave.imag**2) / (size * size * power * change)
        k = min(n_lags, n - 1)
        lags = torch.arange(-k, k + 1, device=like.device) % size
        inner = otf[lags][:, lags]
        # OTF(0) = 1 conserves energy exactly.
        centre = torch.zeros(2 * k + 1, 2 * k + 1, dtype=torch.bool, device=like.device)
        centre[k, k] = True
        inner = torch.where(centre, inner.new_ones(()), inner)
        return nn.functional.pad(inner, (n_lags - k,) * 4), change

    def _pupil_amplitude(
        self, wave_nm: float, n_across: float, samples: Any, at: Floats, field_um: tuple[float, float]
    ) -> tuple[Tensor, Tensor]:
        """Return amplitude and relative transmittance of the current pupil."""
        n, n_pixels, pupil = samples.shape[0], self.pupil.shape[0], self.pupil
        # The shape of the aperture without the picture: the unit disc.
        n_fine = self._aperture._sample_pupil(wave_nm, max(PUPIL_POINTS, n)).shape[0]  # noqa: SLF001
        position = (np.arange(n_fine) + 0.5) * (2.0 / n_fine) - 1.0
        get, key = partial(self._constants.get, like=pupil), f"{wave_nm} {n} {n_fine} {field_um}"
        disc = get(f"disc {key}", compute=lambda: (position**2 + position[:, np.newaxis] ** 2 <= 1.0).astype(float))
        # As in PupilImage, whose rows count from the top: points on a border belong to the pixel below.
        row, column = (
            np.clip(np.floor(0.5 * n_pixels * (1.0 + at_point)), 0, n_pixels - 1).astype(np.int64)
            for at_point in (-position, position)
        )
        of_row, of_column = (
            get(f"{name} {key}", compute=partial(np.asarray, index))
            for name, index in (("row", n_pixels - 1 - row), ("column", column))
        )
        fine = disc * pupil[of_row][:, of_column]
        mean = get(f"mean {key}", compute=lambda: overlaps(n, 2.0 / n_across, n_fine, 2.0 / n_fine).toarray())
        path_um = self._aperture.path_um(at[np.newaxis, :], at[:, np.newaxis], wave_nm, field_um)
        phase = get(f"phase of pupil {key}", compute=lambda: np.exp(2j * np.pi / float(um_from_nm(wave_nm)) * path_um))
        transmittance = (fine * fine).sum() / disc.sum()
        return (mean @ fine @ mean.T) * phase, transmittance / self._aperture.transmittance(wave_nm)

    def _path_change_um(self, at: Floats, field_um: tuple[float, float]) -> Tensor | None:
        """Return the change of the path difference at samples of the aperture, (n, n)."""
        x, y = at[np.newaxis, :], at[:, np.newaxis]
        total: Tensor | None = None
        for name in self.wrt:
            if name == "pupil":
                continue
            get, variable = partial(self._constants.get, like=getattr(self, name)), getattr(self, name)
            # The number of samples differs between wavelengths.
            modes = get(f"{name} {at.size} {field_um}", compute=partial(self._modes, name, x, y, field_um))
            start = get(f"start of {name}", compute=partial(self._start, name))
            change = torch.tensordot((variable - start).reshape(-1), modes, dims=1)
            total = change if total is None else total + change
        return total

    def _modes(self, name: str, x: Floats, y: Floats, field_um: tuple[float, float]) -> Floats:
        """Return the path difference for a unit of each coefficient, (n_coefficient, n, n)."""
        if name == "defocus":
            return np.asarray(x * x + y * y)[np.newaxis]
        if name == "zernike":
            assert self._optics.zernike is not None
            orders = self._optics.zernike.coefficients_um(float(self._scene.wavelength_nm[0]))
            return np.stack([zernike(n, m, x, y) for n, m in orders])
        assert self._optics.seidel is not None
        radius_um = self._optics.seidel.field_radius_um
        units = [Seidel(field_radius_um=radius_um, **{key: 1.0}) for key in SEIDEL_NAMES]
        return np.stack([unit.wavefront_um(x, y, 550.0, field_um) for unit in units])

    def _sample_tables(self, tables: Tensor, per_step: float, n_y: int, n_x: int) -> Tensor:
        """Return transfer functions of cells: sums over the aliases of each frequency."""
        pitch_um = self.grid.pitch_x_um
        n_alias = max(0, math.ceil(self._imaging.f_max_per_um * pitch_um - 0.5))
        if n_alias > MAX_DIRECT_ALIASES:
            raise ParameterError(
                "optics",
                f"must have map cells of at most {(MAX_DIRECT_ALIASES + 0.5) / self._imaging.f_max_per_um:.3g} µm "
                f"for gradients of aberrations, got {pitch_um:.3g} µm; set Optics(oversample=...)",
            )
        k = self._imaging.oversample
        n_source_cells = float(k) if self._imaging.is_square_source else 0.0
        cycles_x, cycles_y = self._cycles(n_y, n_x)
        total = torch.zeros(tables.shape[0], cycles_y.size, cycles_x.size, dtype=tables.dtype, device=tables.device)
        get = partial(self._constants.get, like=tables)
        for a_y in range(-n_alias, n_alias + 1):
            y, gain_y = _alias(cycles_y, a_y, n_source_cells, is_alternating=k % 2 == 0)
            for a_x in range(-n_alias, n_alias + 1):
                x, gain_x = _alias(cycles_x, a_x, n_source_cells, is_alternating=k % 2 == 0)
                gain = get(f"gain {a_y} {a_x} {n_y} {n_x}", compute=partial(np.multiply.outer, gain_y, gain_x))
                total = total + gain * _bilinear(tables, y * per_step / pitch_um, x * per_step / pitch_um)
        return total


def _slices(cells: tuple[Any, Any]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return indices of consecutive cells as slices."""
    to, source = (tuple(slice(int(axis.min()), int(axis.max()) + 1) for axis in part) for part in cells)
    return to, source  # type: ignore[return-value]


class _Padding:
    """Padded part of pictures: repeated pixels, times the falloff."""

    def __init__(self, rows: PatchExtent, columns: PatchExtent, window: Floats, n_y: int) -> None:
        self._runs = _runs(columns.sources)
        self._run_array = np.array(self._runs, np.int64).reshape(-1, 3)
        self._is_even = bool(np.all(window == 1.0))
        self._is_whole = np.array_equal(rows.sources, np.arange(n_y))
        self._constants = Constants(
            window=window, lower=rows.sources, upper=n_y - 1 - rows.sources, columns=columns.sources
        )
        extents = columns, rows
        self._zeros = [n for each in extents for n in (each.pixels.start, each.cells.size - each.pixels.stop)]

    def apply(self, pictures: Tensor, origin: Origin) -> Tensor:
        """Return the padded part of pictures (..., n_y, n_x), bottom row first."""
        window, rows, columns = (self._constants.get(name, pictures) for name in ("window", origin, "columns"))
        if is_array(pictures):
            from foveasim.optics._kernels import pad_pictures

            found = pictures.new_empty(*pictures.shape[:-2], *window.shape)
            flat = pictures.reshape(-1, *pictures.shape[-2:]).contiguous()
            padded = found.view(-1, *window.shape).numpy()
            pad_pictures(flat.numpy(), rows.numpy(), self._run_array, window.numpy(), padded)
        else:
            if origin == "upper" or not self._is_whole:
                pictures = pictures.index_select(-2, rows)
            if len(self._runs) <= MAX_RUNS:
                found = torch.cat([_run(pictures, *each) for each in self._runs], dim=-1)
            else:
                found = pictures.index_select(-1, columns)
            found = found if self._is_even else found * window
        return nn.functional.pad(found, self._zeros) if any(self._zeros) else found


def _runs(sources: Ints) -> list[tuple[int, int, int]]:
    """Return the first pixel, the length and the step (1, -1 or 0) of runs of pixels."""
    runs: list[tuple[int, int, int]] = []
    k = 0
    while k < sources.size:
        step = int(sources[k + 1] - sources[k]) if k + 1 < sources.size else 1
        step = step if abs(step) <= 1 else 1
        n = 1
        while k + n < sources.size and sources[k + n] - sources[k + n - 1] == step:
            n += 1
        runs.append((int(sources[k]), n, step))
        k += n
    return runs


def _run(values: Tensor, first: int, n: int, step: int) -> Tensor:
    """Return a run of elements along the last axis."""
    if step == 0:
        return values.narrow(-1, first, 1).expand(*values.shape[:-1], n)
    run = values.narrow(-1, first if step > 0 else first - n + 1, n)
    return run if step > 0 else run.flip(-1)


def interleaved(transfer: Tensor) -> Tensor:
    """
    Return constant transfer functions without imaginary part as real numbers.

    Twice each, for the real and imaginary parts of spectra.
    """
    if transfer.is_complex() and not bool(transfer.imag.any()):
        return transfer.real.repeat_interleave(2, dim=-1)
    return transfer


def _shifted(cycles: Tensor, shift: Tensor) -> Tensor:
    """Return the factors (n_scene, n_shift, n_cycle) of spectra of shifted cells."""
    angle = 2.0 * math.pi * shift[..., None] * cycles
    factor = torch.complex(torch.cos(angle), torch.sin(angle))
    return torch.where(cycles.abs() == 0.5, factor.real.to(factor.dtype), factor)


def _alias(cycles: Floats, alias: int, n_source_cells: float, *, is_alternating: bool) -> tuple[Floats, Floats]:
    """Return the frequencies of an alias in cycles per cell, and its gains."""
    shifted = cycles + alias
    sign = -1.0 if is_alternating and alias % 2 else 1.0
    return shifted, sign * np.sinc(shifted) * np.sinc(n_source_cells * shifted)


def _bilinear(tables: Tensor, v: Floats, u: Floats) -> Tensor:
    """Interpolate tables at steps (n_v,) and (n_u,) from the centre; 0 outside."""
    half = tables.shape[1] // 2

    def split(at: Floats) -> tuple[Tensor, Tensor, Tensor]:
        is_inside = np.abs(at) < half
        low = np.clip(np.floor(at).astype(np.int64) + half, 0, 2 * half - 1)
        weight = np.where(is_inside, at + half - low, 0.0)
        index, *factors = (torch.from_numpy(each).to(tables.device) for each in (low, weight, is_inside))
        return index, *(each.to(tables.real.dtype) for each in factors)  # type: ignore[return-value]

    (j, wv, in_v), (i, wu, in_u) = split(v), split(u)
    rows = tables[:, j] * (1.0 - wv)[:, None] + tables[:, j + 1] * wv[:, None]
    found = rows[..., i] * (1.0 - wu) + rows[..., i + 1] * wu
    return found * (in_v[:, None] * in_u)


def _osa(n: int, m: int) -> int:
    """Return the OSA/ANSI index of a Zernike polynomial."""
    return (n * (n + 2) + m) // 2


def _check_variables(name: str, wrt: Iterable[str], known: Iterable[str]) -> tuple[str, ...]:
    """Return the names of variables, in a fixed order."""
    known = tuple(known)
    names = (wrt,) if isinstance(wrt, str) else tuple(wrt)
    for variable in names:
        if variable not in known:
            raise ParameterError(
                name, "must contain names of variables", variable, hint=possible_names(str(variable), list(known))
            )
    return tuple(variable for variable in known if variable in names)
