"""Setting types with a range, checked when settings are read or constructed.

A type's description completes the sentence "learner.gamma = 1.5: expected ...".
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

Positive = Annotated[float, Meta(gt=0, description="a number above 0")]
NotNegative = Annotated[float, Meta(ge=0, description="0 or more")]
Share = Annotated[float, Meta(ge=0, le=1, description="a number from 0 to 1")]
PositiveShare = Annotated[float, Meta(gt=0, le=1, description="a number above 0 and at most 1")]
Count = Annotated[int, Meta(ge=1, description="1 or more")]
CountOrZero = Annotated[int, Meta(ge=0, description="0 or more")]
Widths = Annotated[
    tuple[Annotated[int, Meta(ge=1)], ...],
    Meta(min_length=1, description="one layer or more, each at least 1 wide"),
]
