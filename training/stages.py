"""What each stage is given and what it predicts; the one place that puts a stage's inputs together.

Training feeds it cached latents, sampling feeds it what the user gave: both get the same ``StageInputs``.

motion: [ego and/or objects] [RGB frame 0 at latent frame 1000] -> skeleton video. appearance: [skeleton video] -> RGB.
end_to_end: [ego and/or objects] -> RGB. The target's first latent frame is given, clean, in all three.
"""

from collections.abc import Mapping, Sequence

import torch

from labeling.errors import DataError
from training.backbone import Reference, StageInputs, TextEmbedding, pad_text
from training.conditioning import IMAGE_LATENT_FRAME
from training.config import Stage

RGB, IMAGE, EGO, OBJECTS = "rgb", "image", "ego", "objects"
"""Names of latents: the RGB video, its first frame at the control videos' size, the two motion controls."""


def target_name(stage: Stage, *, control: str = "skeleton") -> str:
    """Which latents a stage predicts."""
    return control if stage == "motion" else RGB


def reference_names(stage: Stage, *, control: str = "skeleton") -> tuple[str, ...]:
    """Which latents a stage may be given, in the order of the token sequence."""
    return {"motion": (EGO, OBJECTS, IMAGE), "appearance": (control,), "end_to_end": (EGO, OBJECTS)}[stage]


def stage_inputs(
    stage: Stage,
    *,
    first_frame_CFHW: torch.Tensor,
    target_shape: tuple[int, int, int, int],
    references: Mapping[str, torch.Tensor],
    text: TextEmbedding,
    text_tokens: int,
    fps: float,
    control: str = "skeleton",
    image_1D: torch.Tensor | None = None,
) -> StageInputs:
    """One sample's inputs, as a batch of one.

    Args:
        stage: which adapter is at work.
        first_frame_CFHW: (C, 1, H, W), or the whole target: its first latent frame is taken.
        target_shape: (C, F, H, W) of the target.
        references: latents (C, F, H, W) by name; ``ego`` and ``objects`` may be absent.
        text: the caption.
        text_tokens: padded length.
        fps: video frames per second.
        control: name of the intermediate representation.
        image_1D: the first RGB frame's embedding, for backbones with an image encoder.

    Raises:
        DataError: a condition that the stage cannot do without is absent, or one that it does not take is given.
    """
    allowed = reference_names(stage, control=control)
    unknown = [name for name in references if name not in allowed]
    missing = [name for name in allowed if name not in references and name not in (EGO, OBJECTS)]
    if unknown or missing:
        raise DataError(
            f"the {stage} stage takes {', '.join(allowed)}; missing: {', '.join(missing) or 'none'}, "
            f"not taken: {', '.join(unknown) or 'none'}"
        )
    text_BLD, mask_BL = pad_text([text], length=text_tokens)
    return StageInputs(
        target_shape=target_shape,
        first_frame_BCFHW=first_frame_CFHW[None, :, :1],
        references=tuple(
            Reference(
                name=name,
                latents_BCFHW=references[name][None],
                first_latent_frame=IMAGE_LATENT_FRAME if name == IMAGE else 0,
            )
            for name in allowed
            if name in references
        ),
        slots=allowed,
        text_BLD=text_BLD,
        text_mask_BL=mask_BL,
        fps=fps,
        image_B1D=None if image_1D is None else image_1D[None].float(),
    )


def stack_inputs(inputs: Sequence[StageInputs]) -> StageInputs:
    """Samples of one layout as one batch.

    Raises:
        DataError: layouts differ.
    """
    first = inputs[0]
    if any(other.layout != first.layout for other in inputs):
        raise DataError("samples of different layouts cannot share a batch; group them by StageInputs.layout")
    return StageInputs(
        target_shape=first.target_shape,
        first_frame_BCFHW=torch.cat([one.first_frame_BCFHW for one in inputs]),
        references=tuple(
            Reference(
                name=reference.name,
                latents_BCFHW=torch.cat([one.references[place].latents_BCFHW for one in inputs]),
                first_latent_frame=reference.first_latent_frame,
            )
            for place, reference in enumerate(first.references)
        ),
        text_BLD=torch.cat([one.text_BLD for one in inputs]),
        text_mask_BL=torch.cat([one.text_mask_BL for one in inputs]),
        fps=first.fps,
        slots=first.slots,
        image_B1D=None if first.image_B1D is None else torch.cat([one.image_B1D for one in inputs]),  # type: ignore[misc]
    )
