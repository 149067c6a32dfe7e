"""Published sensors: presets, and data sheets in the terms of EMVA 1288."""
