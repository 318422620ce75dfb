"""What was found in one image's input, and what was done about it: travels with its prediction."""

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Report:
    """What the reading of one image's input found and did.

    Errors are for what cannot be right, warnings for doubt; all else is a fact.

    Attributes:
        facts: What was found and done, by name: numbers of points and pixels dropped, the order of the keypoints, ...
        warnings: A sentence for each doubt: what was expected, what came, the fix.
        is_strict: Whether a doubt is an error.
    """

    facts: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    is_strict: bool = False

    def note(self, **facts: Any) -> None:
        """Add facts."""
        self.facts.update(facts)

    def doubt(self, warning: str) -> None:
        """Add a warning.

        Raises:
            ValueError: The report is strict.
        """
        if self.is_strict:
            raise ValueError(f"{warning} (an error, because of strict=true)")
        self.warnings.append(warning)
