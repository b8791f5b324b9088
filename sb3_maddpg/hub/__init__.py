"""Models to share: folders with a model card, the Hugging Face Hub, and models that packages offer."""

from sb3_maddpg.hub.model_card import publish, write_model_folder

__all__ = ["publish", "write_model_folder"]
