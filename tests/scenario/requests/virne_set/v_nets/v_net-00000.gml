graph [
  node_attrs_setting "_networkx_list_start"
  node_attrs_setting [ name "cpu" type "resource" owner "node" low "0" high "100" ]
  topology___type "path"
  id 0
  arrival_time 1.0
  lifetime 10.0
  node [ id 0 label "0" cpu 85 ]
]
