"""The class of each closure's error, given the predictions by all else: whether it joins the right places."""
