"""The pictures of docs/export.md, a function each: `(what was exported, the picture to write)`."""
