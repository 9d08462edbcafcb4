"""How ego-motion is estimated: the settings of every part in one place."""

from pydantic import BaseModel, ConfigDict, Field

from labeling.ego_corners import TrackSettings


class EgoSettings(BaseModel):
    """How ego-motion is estimated."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    tracks: TrackSettings = TrackSettings()
    noise_px: float = Field(default=0.1, gt=0)
    """Least standard deviation of a tracked corner, pixels of the working picture."""
    least_corners: int = Field(default=20, ge=8)
    """With fewer the last motion is held."""
    least_inlier_share: float = Field(default=0.6, gt=0, lt=1)
    """Below it other starts are proposed: five-point RANSAC, the homography's decomposition."""
    axis_walk_rad: float = Field(default=0.15, gt=0)
    """How far the direction of travel wanders against the camera, radians in the first second."""
    parallax_px: float = Field(default=3.0, gt=0)
    """With less median parallax than this, several steps are taken together."""
    window_reach: int = Field(default=4, ge=0)
    """Steps on either side that may be taken together; 0 takes none."""
    switch_cost: float = Field(default=8.0, ge=0)
    """Log likelihood that a change of mode costs (hysteresis)."""
    turn_back_cost: float = Field(default=12.0, ge=0)
    """Log likelihood that a change between forward and backward costs."""
    scale_walk: float = Field(default=0.04, gt=0)
    """How far the logarithm of the metric scale wanders along a chain of relative steps, in the first second."""
    smoothing_lag: int = Field(default=4, ge=0)
    """Frames on either side that smooth a step; 0 leaves steps as measured."""
    default_depth_heights: float = Field(default=8.0, gt=0)
    """Median depth of the scene in camera heights, where no road has been seen anywhere in the run."""
