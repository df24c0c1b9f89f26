"""What a run says about regions: a row a method, the price of every recall, and what proposals save."""
