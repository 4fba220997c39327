graph [
  node_attrs_setting [ name "cpu" type "resource" owner "node" high "100" low "50" ]
  topology___num_nodes "3"
  node [ id 0 label "0" pos 0.2 pos 0.3 cpu 78 max_cpu 78 ]
  node [ id 1 label "1" pos 0.6 pos 0.3 cpu 87 max_cpu 87 ]
  node [ id 2 label "2" pos 0.1 pos 0.5 cpu 67 max_cpu 67 ]
  edge [ source 0 target 1 bw 54 max_bw 54 ]
  edge [ source 1 target 2 bw 86 max_bw 86 ]
]
