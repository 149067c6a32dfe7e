// Picture that is reconstructed from the codes.

export const create = (root, { panes, ask }) => ({
  use({ about, arrays }) {
    panes.picture.use(about, arrays.rgba);
    ask("picture");
  },
});
