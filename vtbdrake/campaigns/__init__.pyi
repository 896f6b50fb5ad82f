"""Campaigns."""

from .campaign import Campaign as Campaign
from .campaign import CampaignError as CampaignError
from .results import CampaignResult as CampaignResult
