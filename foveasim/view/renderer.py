"""
Detection of the OpenGL renderers that VTK can use on this machine.

Without OpenGL, VTK terminates the interpreter instead of raising an exception. Libraries are therefore queried first, without
VTK; then a separate process renders a few pixels with VTK. A renderer that passes this trial is used.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec

from foveasim._core.extras import needs

__all__ = ["ON_SCREEN", "begin_rendering", "find_renderer", "missing_software"]

#: Environment variable that selects VTK's window class, and names of these classes.
VTK_VARIABLE = "VTK_DEFAULT_OPENGL_WINDOW"
X11, EGL, OSMESA = "vtkXOpenGLRenderWindow", "vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow"
#: Systems whose native windows VTK always supports.
NATIVE_WINDOWS = {"darwin": "vtkCocoaRenderWindow", "win32": "vtkWin32OpenGLRenderWindow"}
#: Window classes that display on a screen.
ON_SCREEN = frozenset({X11, *NATIVE_WINDOWS.values()})
#: From the EGL headers: a display without a screen (EGL_MESA_platform_surfaceless).
EGL_PLATFORM_SURFACELESS_MESA = 0x31DD
#: Time limit of a trial.
TRIAL_S = 60.0
#: Renders 8 x 8 pixels of one colour and compares them.
TRIAL = """
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkUnsignedCharArray
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow
renderer, window = vtkRenderer(), vtkRenderWindow()
renderer.SetBackground(1.0, 0.0, 1.0)
window.SetOffScreenRendering(1)
window.SetMultiSamples(0)
window.SetSize(8, 8)
window.AddRenderer(renderer)
window.Render()
pixels = vtkUnsignedCharArray()
window.GetPixelData(0, 0, 7, 7, 1, pixels, 0)
raise SystemExit(vtk_to_numpy(pixels).tolist() != [[255, 0, 255]] * 64)
"""


@cache
def find_renderer() -> str | None:
    """
    Return the window class with which VTK can render on this machine; cached.

    Returns
    -------
    str or None
        Name of the VTK class: on a screen, or without a screen by EGL or OSMesa; None if there is none, or no VTK.

    Notes
    -----
    ``VTK_DEFAULT_OPENGL_WINDOW`` in the environment is tried first. On the first call a separate process renders a few
    pixels, which takes some tenths of a second; a crash terminates that process only.
    """
    if find_spec("vtkmodules") is None:
        return None
    return next((name for name in dict.fromkeys(_candidates()) if _can_render(name)), None)


def begin_rendering() -> None:
    """
    Select VTK's window class in the environment.

    Must be called before VTK creates its first window. Without effect if :func:`find_renderer` finds no class.
    """
    found = find_renderer()
    if found is not None:
        os.environ[VTK_VARIABLE] = found


def missing_software() -> str:
    """Return a message on the software that PyVista rendering lacks; empty if it is complete."""
    if any(find_spec(module) is None for module in ("pyvista", "vtkmodules")):
        return f"rendering {needs('pyvista')}"
    if find_renderer() is None:
        return "this machine has no OpenGL; install it, on Debian and Ubuntu with: apt install libegl1 libgl1"
    return ""


def _candidates() -> Iterator[str]:
    """Yield the window classes whose libraries are available and respond, the best first."""
    if os.environ.get(VTK_VARIABLE):
        yield os.environ[VTK_VARIABLE]
    if sys.platform in NATIVE_WINDOWS:
        yield NATIVE_WINDOWS[sys.platform]
        return
    if os.environ.get("DISPLAY") and _opens_display():
        yield X11
    if _initialises_egl():
        yield EGL
    if _load_library("libOSMesa.so.8") is not None:
        yield OSMESA


def _can_render(window: str) -> bool:
    """Return whether a separate process renders with a window class."""
    command = [sys.executable, "-P", "-c", TRIAL]
    try:
        trial = subprocess.run(  # noqa: S603 -- fixed command
            command, env={**os.environ, VTK_VARIABLE: window}, capture_output=True, timeout=TRIAL_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return trial.returncode == 0


def _load_library(name: str) -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL(name)
    except OSError:
        return None


def _opens_display() -> bool:
    """Return whether X11 opens a display; the variable DISPLAY alone is not sufficient."""
    x11 = _load_library("libX11.so.6")
    if x11 is None:
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XOpenDisplay.argtypes = (ctypes.c_char_p,)
    x11.XCloseDisplay.argtypes = (ctypes.c_void_p,)
    display = x11.XOpenDisplay(None)
    if not display:
        return False
    x11.XCloseDisplay(display)
    return True


def _initialises_egl() -> bool:
    """
    Return whether EGL finds a driver for a display without a screen.

    The library without a driver makes VTK crash.
    """
    os.environ.setdefault("EGL_LOG_LEVEL", "fatal")  # otherwise Mesa prints missing paths
    egl = _load_library("libEGL.so.1")
    if egl is None:
        return False
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = (ctypes.c_char_p,)
    egl.eglGetDisplay.restype = ctypes.c_void_p
    egl.eglGetDisplay.argtypes = (ctypes.c_void_p,)
    for function in (egl.eglInitialize, egl.eglTerminate):
        function.restype = ctypes.c_uint
    egl.eglInitialize.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)
    egl.eglTerminate.argtypes = (ctypes.c_void_p,)
    displays = [egl.eglGetDisplay(None)]
    address = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if address:
        get = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)(address)
        displays.insert(0, get(EGL_PLATFORM_SURFACELESS_MESA, None, None))
    for display in filter(None, displays):
        if egl.eglInitialize(display, None, None):
            egl.eglTerminate(display)
            return True
    return False
