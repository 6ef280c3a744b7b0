"""The pictures of docs/export, a function each: `(what was exported, the picture to write)`."""
