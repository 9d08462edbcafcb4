"""What counts when labels are judged: who is asked for, who is found, which point is right, which score says hidden.

One set of figures for the shipped models, the charts and stability tables, the evaluation and the study.
"""

JUDGED_HEIGHT_PX = 32.0
"""Objects as high as this are asked for, pixels of 1056x704; lower ones may be found or not."""
JUDGED_SHARE = 0.3
"""Objects of which this share is visible are asked for."""
MATCH_IOU = 0.3
"""Least overlap of two boxes that are taken for one object."""
EXCUSED_SHARE = 0.5
"""A box of which more than this share lies on an object that is not asked for is no phantom."""
LANE_MATCH_PX = 20.0
"""Most that the points of a lane line may lie off the line that it is taken for, by the mean."""
PCK_SHARE = 0.1
"""Points within this share of the box diagonal are right (PCK@0.1, Yang and Ramanan 2013)."""
HIDDEN_SCORE = 0.3
"""Points that score less are said to be hidden."""
SURE_SCORE = 0.9
"""Points that score as much are said to be sure."""
