// Optical image.

export const create = (root, { panes, ask }) => ({
  use({ about, arrays }) {
    panes.scene.use({ ...about, frame_um: panes.b.sites?.bounds }, arrays.rgba);
    ask("scene");
  },
});
