"""Two LoRA adapters, motion and appearance, on one frozen video diffusion backbone."""
