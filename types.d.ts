// Data of the pages for the checker of JavaScript: messages of the studio's server (foveasim/studio) and contents of pages
// (foveasim/view/web/_content.py, _bodies.py). Names without imports, for @type comments; browsers never load this file.

type Sites = import("./foveasim/view/web/sites.js").Sites;
type Scale = import("./foveasim/view/web/colours.js").Scale;
type MapView = import("./foveasim/view/web/map.js").MapView;
type RulesList = import("./foveasim/view/web/rules_list.js").RulesList;
type SensorMap = import("./foveasim/view/web/map.js").SensorMap;
type SolidView = import("./foveasim/view/web/solid_view.js").SolidView;
type Overview = import("./foveasim/view/web/overview.js").Overview;
type RasterMap = import("./foveasim/studio/static/raster_map.js").RasterMap;
type SitePane = import("./foveasim/studio/static/site_pane.js").SitePane;
type ImagePane = import("./foveasim/studio/static/image_pane.js").ImagePane;
type Film = import("./foveasim/studio/static/film.js").Film;
type Connection = import("./foveasim/studio/static/connection.js").Connection;
type Rate = import("./foveasim/studio/static/film.js").Rate;

// -- geometry and values ------------------------------------------------------------------------------------------------

type Numbers = Uint8Array | Int8Array | Uint16Array | Int16Array | Uint32Array | Int32Array | Float32Array | Float64Array;
type Point = [number, number];
type Interval = [number, number];
type Rectangle = [Point, Point];
// Plain data of settings, whose schema is that of foveasim.schema().
type Settings = { [name: string]: any };
interface Placed { x: number; y: number }
interface Snapped extends Placed { kind?: string; isExact?: boolean; distance?: number; segment?: number[] }
interface Outline { points: number[][]; isClosed?: boolean; isBox?: boolean; isFaint?: boolean; marks?: number[][]; site?: number }
// Conversions between µm and CSS pixels.
interface View { toX(x: number): number; toY(y: number): number; fromX(px: number): number; fromY(py: number): number }
interface Cursor extends Placed { from: unknown }
interface Renderer { isSlow: boolean }
interface Fitted { context: CanvasRenderingContext2D; width: number; height: number }

// -- contents of pages ----------------------------------------------------------------------------------------------------

interface Column {
  key: string; label: string; unit: string; kind: "linear" | "grey" | "lit" | "kinds";
  array?: string; of?: "area" | "size"; names?: string[]; colours?: string[]; note?: string;
  is_integer?: boolean; is_repeat?: boolean; is_signal?: boolean;
  values: Numbers;  // from arrays, when they are decoded
}
interface Palette { kinds: string[]; no_data: string; gamma: number }
interface Rule {
  name: string; description: string; limit: number | null; unit: string; count: number; listed: number; waiver: string | null;
}
interface SitesAbout { n_sites: number; bounds_um: number[]; palette: Palette }
interface ColumnsAbout { columns: Column[]; filter: string | null; notes: string[] }
interface BodiesAbout {
  lattice_um: number; origin_um: number[]; low_um: number[]; high_um: number[]; list: { name: string; n_runs: number; n_tiles: number }[];
}
interface PictureAbout { width: number; height: number; bounds_um: number[]; frame_um?: number[] }
type Arrays = { [name: string]: any };

// -- messages of the server -----------------------------------------------------------------------------------------------

interface Preset { name: string; label: string; kind: string }
interface ViewAbout {
  name: string; label: string; group: string; is_tile: boolean; is_first: boolean; is_wide: boolean; is_lazy: boolean; has_data: boolean;
}
// file: key of a file that the value lacks, as it lacks the required and optional parameters with these names.
interface Choice { label: string; value: any; file?: string; required?: string[]; optional?: string[] }
interface Control {
  key: string; id: string; label: string; unit: string; help: string; section: string; synonyms?: string; context?: string;
  kind: "number" | "integer" | "boolean" | "text" | "file" | "list" | "choice" | "sections" | "group";
  do?: string; value?: string | null;  // of a choice that is no setting: its message, and the present choice
  default?: any; is_required?: boolean; is_optional?: boolean; is_item?: boolean;
  minimum?: number | null; maximum?: number | null; suggested?: number[]; scale?: "log" | "linear";
  choices?: Choice[]; selected?: number | null; length?: number | null;
  is_value?: boolean;  // set by the page: the value after the choice of its form
}
interface FilmAbout {
  kind: "camera" | "video"; name: string; n: number; n_frames: number | null; frame_s: number | null; width: number; height: number;
}
type Summary = { [name: string]: number };
interface Hello {
  kind: "hello"; session: string; version: string; is_new: boolean; presets: Preset[]; name: string; can_save: boolean;
  settings: Settings; controls: Control[]; views: ViewAbout[]; shows_start_page: boolean;
}
interface StartPreset extends Preset { text: string; picture: string }
interface RecentFile { name: string; path: string; directory: string; time_s: number }
// Of the start page, which requests it.
interface StartContents {
  presets: StartPreset[]; generators: { name: string; label: string; text: string; fills_format: boolean; has_mosaic: boolean }[];
  formats: { name: string; label: string; size_um: number[]; source: string }[]; mosaics: { name: string; label: string }[];
  electronics: { name: string; label: string; source: string; scaling: string }[]; max_sites: number; recent: RecentFile[] | null;
  initial: { generator: string; format: string; n_sites: number; frames_per_s: number; filters: string; electronics: string };
}
interface Busy { kind: "busy" }
interface ControlsMessage { kind: "controls"; controls: Control[] }
interface State {
  kind: "state"; id: number | null; version: number; settings: Settings; changed: string[]; can_undo: boolean; can_redo: boolean;
  errors: { [key: string]: string }; warnings: string[]; notes: string[]; solved: { [key: string]: number }; summary: Summary; frozen: { summary: Summary; settings: Settings } | null;
  variants: { id: string; name: string; note: string; is_compared: boolean; problem: string | null }[];
  film: FilmAbout | null; is_preview: boolean;
}
interface Done {
  kind: "done"; id: number | null; version: number; ms: { [view: string]: number }; is_preview: boolean; is_freeze: boolean;
  is_followed: boolean;
}
interface Failure { kind: "error"; id: number | null; text: string; part?: string }
interface TextMessage { kind: "text"; id: number; what: string; text: string; files: string[] }
interface Note { kind: "note"; text: string }
interface Progress { kind: "progress"; text: string }
interface Sought {
  kind: "sought"; id: number; key: string; label: string; unit: string; value: number; result: number; subject: string; measure: string;
  result_unit: string;
  limits: (number | null)[]; curve: (number | null)[][]; is_present: boolean; saturated_fraction: number;
}
// What a method of repair would change; without numbers if it cannot be applied.
interface RepairPreview {
  kind: "repair"; id: number; method: string; text: string;
  before?: { n_sites: number; area_um2: number }; after?: { n_sites: number; area_um2: number };
}
interface SweepAxis { key: string; label: string; unit: string; values: number[]; is_log: boolean }
interface SweepMessage {
  kind: "sweep"; id: number; state: "running" | "stopped" | "lost" | "done"; axes: SweepAxis[];
  results: { measure: string; label: string; subject: string; unit: string }[]; n_points: number; points: (number | string | null)[][];
  start: { settings: (number | null)[]; results: (number | string | null)[] | null }; problem: string; n_failed: number;
  saturated: number[] | null; isLost?: boolean;
}
interface Exists { kind: "exists"; id: number; name: string; file: string }
interface Saved { kind: "saved"; id: number; path: string }
interface GazePathMessage { kind: "gaze_path"; rows: [number, number, number][]; problem: string; step_s: number }
// Times of the frames of a video that are not at equal steps.
interface FilmTimes { kind: "film_times"; times_s: number[] | null }
type ServerMessage = Busy | ControlsMessage | State | Done | Failure | TextMessage | Saved | Note | Progress | Exists | Sought | SweepMessage
  | GazePathMessage | FilmTimes | RepairPreview;

// Binary messages: a header and arrays; as readPart returns them.
interface PartHeader {
  part: string; version: number; about: any; is_preview?: boolean; has_more?: boolean; is_awaited?: boolean;
  arrays: { name: string; type: ArrayType; size: number; offset: number }[];
}
type ArrayType = "uint8" | "int8" | "uint16" | "int16" | "uint32" | "int32" | "float32" | "float64";
interface Part {
  part: string; version: number; is_preview: boolean; hasMore: boolean; isAwaited: boolean; about: any; arrays: Arrays;
  sites?: Sites; boundary?: Boundary; columns?: Column[] | null;  // of views, prepared while the server computes
}
type Boundary = (context: CanvasRenderingContext2D, toX: (x: number) => number, toY: (y: number) => number) => void;

// -- messages to the server; Connection.send adds their numbers -------------------------------------------------------------
// python tests/reference/page_messages.py writes them, from foveasim/studio/_messages/models.py.

type Change =
  | { do: "set"; key: string; value?: unknown; final?: boolean }
  | { do: "assign"; values: { key: string; value?: unknown }[] }
  | { do: "reset"; key: string }
  | { do: "delete"; key: string }
  | { do: "seek"; key: string; requirement: { [name: string]: unknown } | undefined; bounds?: number[] | null }
  | { do: "solve"; name: string }
  | { do: "fit" }
  | { do: "match"; what?: "field" | "n_sites" | "both" | "data_rate" }
  | { do: "repair"; method: "best" | "drop" | "shrink" | "merge" | "refill" }
  | { do: "apply"; variant: string }
  | { do: "preset"; name: string }
  | { do: "new_sensor"; generator: string; size_um?: number[] | null; n_sites?: number | null; min_size_um?: number | null; sites_per_deg?: number | null; pixels_per_s?: number | null; frames_per_s?: number | null; filters?: string | null; electronics: string }
  | { do: "restore"; settings: { [name: string]: unknown } | undefined }
  | { do: "file"; path: string | undefined; as?: "scene" | "layout" | "settings" | null }
  | { do: "video"; path: string | undefined }
  | { do: "frame"; n: number; follows?: boolean; final?: boolean }
  | { do: "follow"; t_s: number; final?: boolean }
  | { do: "gaze_file"; path: string | undefined }
  | { do: "saccades"; seed?: number | null; duration_s?: number | null; fixation_s?: number | null; drift_um_per_root_s?: number | null }
  | { do: "undo" }
  | { do: "redo" }
  | { do: "refresh" }
  | { do: "views"; names: string[]; pixels?: number | null }
  | { do: "pin"; sites: number[] }
  | { do: "freeze"; variant?: string | null }
  | { do: "unfreeze" }
  | { do: "variant"; action: "keep" | "update" | "describe" | "delete"; variant?: string; name?: string; note?: string }
  | { do: "compare"; variants: string[] }
  | { do: "preview_repairs" }
  | { do: "sweep"; settings: { key: string; [name: string]: unknown }[] | undefined; results: { [name: string]: unknown }[] | undefined }
  | { do: "stop_sweep" }
  | { do: "sweep_file" }
  | { do: "text"; what: string }
  | { do: "save"; name: string; may_replace?: boolean }
  | { do: "drawn"; version: number }
  | { do: "cancel" };
interface FrameHeader { is_first?: boolean; width: number; height: number }

// -- parts of pages -----------------------------------------------------------------------------------------------------------

interface ArrayAbout { type: ArrayType; size: number }
interface Trace { path: (context: CanvasRenderingContext2D, map: MapView) => void; box: Float64Array }
interface HostMessage { foveasim: string; name: string; value: unknown }
interface PointerCallbacks {
  takesRightButton?: boolean;
  press?(px: number, py: number): void;
  drag(dx: number, dy: number, about: { px: number; py: number; isSecond: boolean; isMiddle: boolean }): void;
  pinch(factor: number, px: number, py: number): void;
  wheel(factor: number, px: number, py: number): void;
  click(px: number, py: number): void;
  move(px: number, py: number, isHeld: boolean): void;
  leave(): void;
}
