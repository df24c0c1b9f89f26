"""Programs that measure descriptors: what each recognises and costs, and what larger or smaller networks give."""
