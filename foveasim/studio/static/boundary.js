// Boundary of a layout: edges of its outlines that no two photosites have in common.

// Returns a function that traces the boundary on a context through conversions from µm to pixels; the box without edges, which are
// pairs of positions.
/** @param {Sites} sites @param {Numbers | undefined} edges */
export function boundaryOf({ bounds: [x0, y0, x1, y1], xy }, edges) {
  return (context, toX, toY) => {
    if (!edges) {
      context.rect(toX(x0), toY(y1), toX(x1) - toX(x0), toY(y0) - toY(y1));
      return;
    }
    for (let i = 0; i < edges.length; i += 2) {
      context.moveTo(toX(xy[2 * edges[i]]), toY(xy[2 * edges[i] + 1]));
      context.lineTo(toX(xy[2 * edges[i + 1]]), toY(xy[2 * edges[i + 1] + 1]));
    }
  };
}
