"""The checker of annotations in tests: jaxtyping hands it every function of the three packages."""

from beartype import BeartypeConf, beartype

# An int where a float is annotated is right, as mypy has it too (PEP 484's numeric tower).
checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
