from .array_spec import ArraySpec, ArrayType, Expected, check_types
from .format_number import require_format
from .json_file import parse_json, read_json
from .npz_file import read_npz
from .plain_file import read_bytes, require_plain_file
from .tensor_file import parse_tensors, read_tensors
from .yaml_file import Key, YamlError, dump_yaml, parse_yaml, parse_yaml_value
from .zip_file import opened_zip, read_member

__all__ = [
    "ArraySpec",
    "ArrayType",
    "Expected",
    "Key",
    "YamlError",
    "check_types",
    "dump_yaml",
    "opened_zip",
    "parse_json",
    "parse_tensors",
    "parse_yaml",
    "parse_yaml_value",
    "read_bytes",
    "read_json",
    "read_member",
    "read_npz",
    "read_tensors",
    "require_format",
    "require_plain_file",
]
