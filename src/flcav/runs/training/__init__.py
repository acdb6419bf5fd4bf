"""The three stages of training: centralised pretraining, edge federated learning, cloud federated learning.

Stage I: labelled samples are uploaded to the cloud, which trains on them; roadside sensors are placed by the errors of
its network. Stage II: vehicles federate with their edge server. Stage III: edge servers federate with the cloud (Wang
et al., IEEE Network 37(3), 2023). All messages are entered in a ledger.
"""
